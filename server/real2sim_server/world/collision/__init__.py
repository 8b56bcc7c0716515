"""Collisions: who touches whom, impulses exchanged, and what they leave."""
