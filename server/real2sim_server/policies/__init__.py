"""Planners judged: many episodes of many planners, their scores, and a page that compares them.

This room stands above all others and plays the user: it drives by the SDK, and scores what the
worker recorded.
"""
