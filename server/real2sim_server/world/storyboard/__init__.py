"""Storyboards: triggered actions of entities, after OpenSCENARIO XML.

:mod:`.program` prepares a storyboard, :mod:`.run` runs it, and :mod:`.progress` steps it.
:mod:`.view` has the entities, :mod:`.motion` moves them, and :mod:`.roads` has roads and
trajectories.
"""
