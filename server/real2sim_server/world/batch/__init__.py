"""Many worlds of one scene that step together: for learning, where a step must cost microseconds.

``BatchWorld`` is a ``World`` for each of its places, within the part of the closed loop that
:mod:`.subset` names; the same plans lead to the same motions, contacts and ends.
"""

from .batch_world import BatchWorld, check_batchable

__all__ = ["BatchWorld", "check_batchable"]
