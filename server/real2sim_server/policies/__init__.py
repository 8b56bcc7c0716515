"""Planners compared: many episodes of many planners, their scores, a page that shows them, and a
policy that is trained by behaviour cloning.

Episodes are driven by the SDK, as a user would, and scored from what the worker recorded.
"""
