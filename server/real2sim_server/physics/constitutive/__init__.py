"""What deformation does to one particle: stress, return mapping, viscosity.

Plain functions of scalars and tuples, compiled for every backend; see :mod:`..numerics`.
"""
