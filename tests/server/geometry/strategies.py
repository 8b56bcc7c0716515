"""Random rotations and vectors."""

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

components = st.floats(-1, 1, allow_subnormal=False)
quaternions = (
    arrays(np.float64, 4, elements=components)
    .filter(lambda q: np.linalg.norm(q) > 1e-2)
    .map(lambda q: q / np.linalg.norm(q))
)
vectors = arrays(np.float64, 3, elements=st.floats(-100, 100))
