"""The same physics in other frameworks, as fast as they let it be."""
