"""Frames for serving, drawn by CUDA kernels of our own.

NVRTC compiles ``kernels/`` where they are used: no nvcc and no C++ compiler. Everything that a
frame needs goes to the device in one copy, a fixed number of launches draws all cameras of all
sizes, and the images come back in one copy.
"""
