"""Planner comparison over many episodes, with scores and an HTML page, and a policy trained by
behaviour cloning.

Episodes are driven through the SDK. Scores are computed from the worker's recordings.
"""
