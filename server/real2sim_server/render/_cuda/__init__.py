"""CUDA backends: gsplat behind the common call, and serving kernels compiled by NVRTC.

NVRTC compiles ``kernels/`` on the user's machine, without nvcc or a C++ compiler. All inputs of a
frame are copied to the device at once, a fixed number of launches draws all cameras of all sizes,
and the images are copied back at once.
"""
