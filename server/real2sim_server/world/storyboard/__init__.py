"""Storyboards: what entities of an episode do, and when.

:mod:`.program` is a prepared storyboard, :mod:`.run` a running one, :mod:`.progress` its steps.
:mod:`.view` has the entities, moved by :mod:`.motion`; :mod:`.roads` has roads and trajectories.
"""
