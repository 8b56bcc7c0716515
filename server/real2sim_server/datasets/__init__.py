"""Labelled data sets of edited streets: labels of rendered frames, and writers of public formats.

- ``drive``: the exported drive, a scenario or a recorded episode, as states over time;
- ``labels``: labels of a time step and of every pixel, from one pass per camera;
- ``clips``: labelled clips, in a crash-safe store;
- ``writers``: one module per format, behind one Protocol;
- ``export``: the complete export, from a drive to a folder.

The manifest of an export describes the source of each label, see :data:`~.labels.HOW`.
"""
