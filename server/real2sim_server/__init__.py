"""The Real2Sim worker: scenes of Gaussians, their editing, physics, rendering and closed loop."""
