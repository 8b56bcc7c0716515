"""Labelled data sets of edited streets: labels of what is drawn, and writers of public formats.

- ``drive``: what is exported, a scenario or a recorded episode, instant by instant;
- ``labels``: what is known of an instant and of every pixel, from one pass per camera;
- ``clips``: an instant after the other, labelled, in a store of whole clips that survives a kill;
- ``writers``: one module a format, behind one Protocol;
- ``export``: the whole way, from a drive to a folder.

A label says how it was made in the manifest of its export, see :data:`~.labels.HOW`.
"""
