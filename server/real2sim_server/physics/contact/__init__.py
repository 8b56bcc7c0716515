"""Contact at one grid node: where surfaces are, how far colliders are, what a contact does.

Plain functions of scalars and tuples, compiled for every backend; see :mod:`..numerics`.
"""
