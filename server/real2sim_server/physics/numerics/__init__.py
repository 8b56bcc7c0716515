"""Functions of scalars and tuples that kernels of every backend are made of.

They are compiled for the CPU and for CUDA from one source, and run as they stand under the CUDA
simulator. Precision follows the arguments: every constant is a float32 that is exact or good
enough, so float64 in gives float64 out.
"""
