"""The product shown end to end: a street is made, served, edited and driven through.

The demo does what a user would: it talks to its worker only by the SDK.
"""
