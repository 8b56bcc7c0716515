"""Scenarios as people write them: files of storyboards, and a gallery of corner cases."""
