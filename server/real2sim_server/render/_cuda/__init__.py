"""CUDA backends: gsplat behind the common call, and serving kernels compiled by NVRTC.

NVRTC compiles ``kernels/`` on the machine that uses them: no nvcc and no C++ compiler. Everything
that a frame needs goes to the device in one copy, a fixed number of launches draws all cameras of
all sizes, and the images come back in one copy.
"""
