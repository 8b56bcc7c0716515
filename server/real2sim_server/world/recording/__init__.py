"""Recording, replay and export of episodes."""
