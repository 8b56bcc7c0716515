"""Version of the SDK."""

from importlib.metadata import PackageNotFoundError, version

try:
    VERSION = version("real2sim")
except PackageNotFoundError:
    VERSION = "0+unknown"

SDK = f"real2sim-python/{VERSION}"
