"""A material as kernels read it: one row of numbers, columns by name."""

from __future__ import annotations

COROTATED, NEO_HOOKEAN, VON_MISES, VISCOPLASTIC, DRUCKER_PRAGER, SNOW, CRUSH = range(7)
"""Codes of constitutive laws in column LAW; see :mod:`.law`."""
LAW, MU, LAMBDA, VISCOSITY, A, B, C, PLASTIC = range(8)
"""Columns. A, B and C are read by law. VISCOSITY above 0 damps; PLASTIC above 0 keeps F_total."""
MATERIAL_ROW = 8
