"""Comparison of planners: many episodes of many planners, their scores, an HTML page, and a policy
trained by behaviour cloning.

The SDK drives the episodes, like a user, and scores come from the worker's recordings.
"""
