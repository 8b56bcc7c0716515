"""The code blocks of the pages about formats, people and operation run, as the pages promise."""

from __future__ import annotations
