"""Real2Sim: drive a policy through a reconstructed street over the network."""
