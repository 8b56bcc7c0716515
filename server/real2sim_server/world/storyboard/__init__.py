"""Storyboards: triggered actions of entities, after OpenSCENARIO XML.

:mod:`.program` prepares a storyboard, :mod:`.run` runs it, and :mod:`.progress` steps it.
:mod:`.view` contains the entities, :mod:`.motion` moves them, and :mod:`.roads` provides roads and
trajectories.
"""
