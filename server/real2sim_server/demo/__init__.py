"""End-to-end demo: builds, serves, edits and drives through a street.

Like a user, the demo accesses its worker only through the SDK.
"""
