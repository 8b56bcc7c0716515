"""CUDA backends: gsplat behind the common call, and serving kernels compiled by NVRTC.

NVRTC compiles ``kernels/`` on the user's machine, without nvcc or a C++ compiler. A frame needs one
copy of all inputs to the device, a fixed number of launches for all cameras of all sizes, and one
copy of the images back.
"""
