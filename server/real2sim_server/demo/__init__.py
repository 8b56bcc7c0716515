"""The product shown end to end: a street is made, served, edited and driven through.

This room stands above all others and plays the user: it talks to its worker only by the SDK.
"""
