"""Rotations, poses and boxes, with their kernels."""
