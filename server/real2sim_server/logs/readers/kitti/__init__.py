"""KITTI: tracking layout and raw drives."""
