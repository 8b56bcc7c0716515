"""Collisions: contacts, impulses, motion after impacts, and deformation."""
