"""Storyboards: what entities of an episode do, and when.

``program`` is a storyboard prepared, ``run`` one that runs, ``progress`` what happens in a step of
the clock; ``entity_state`` is an entity, moved by what ``longitudinal``, ``lateral`` and
``trajectory`` hold, which ``begin_actions`` begins; ``conditions`` say when. Roads come by the
Protocol of ``roads``.
"""
