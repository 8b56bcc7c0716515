"""What happens at one particle or one grid node: weights, stress, return mapping, contact.

Plain functions of scalars and tuples. They are compiled for the CPU and for CUDA from one source,
and run as they stand under the CUDA simulator. Precision follows the arguments: every constant is
a float32 that is exact or good enough, so float64 in gives float64 out.
"""
