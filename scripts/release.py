"""Make a release commit and its tag: ``python scripts/release.py 0.2.0``.

Sets the version of both distributions, moves the fragments of ``changelog.d`` to ``CHANGELOG.md``,
dates the release notes, and writes the hashes of the contract anew. Push the result with
``git push --follow-tags``; the workflow ``release`` then tests, builds and publishes it.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
from datetime import UTC, date, datetime
from pathlib import Path

from packaging.version import InvalidVersion, Version

REPOSITORY = Path(__file__).resolve().parents[1]
NOTES = "docs/site/release_notes.md"


def prepare(root: Path, version: str, day: date) -> None:
    """Write ``version`` into the files of a checkout, without committing.

    Args:
        root: the checkout.
        version: such as ``0.2.0``, newer than the current one.
        day: date of the release.

    Raises:
        ValueError: not a version, not newer than the current one, or no fragments.
    """
    manifests = [root / "pyproject.toml", root / "client/pyproject.toml"]
    current = re.findall(r'(?m)^version = "(.+)"$', manifests[0].read_text("utf-8"))[0]
    try:
        newer = Version(version) > Version(current)
    except InvalidVersion:
        raise ValueError(f"{version!r} is not a version such as 0.2.0") from None
    if not newer:
        raise ValueError(f"{version} is not newer than the current version {current}")
    if not any((root / "changelog.d").glob("*.md")):
        raise ValueError("changelog.d has no fragments: this release would change nothing")
    for manifest in manifests:
        text = manifest.read_text("utf-8")
        text = text.replace(f'version = "{current}"', f'version = "{version}"', 1)
        text = re.sub(rf"(real2sim(?:-server)?)=={re.escape(current)}", rf"\1=={version}", text)
        manifest.write_text(text, "utf-8")
    towncrier = [sys.executable, "-m", "towncrier", "build", "--yes"]
    towncrier += ["--version", version, "--date", day.isoformat(), "--dir", str(root)]
    subprocess.run(towncrier, check=True, cwd=root)
    notes = root / NOTES
    text = notes.read_text("utf-8")
    notes.write_text(text.replace("## Unreleased", f"## {version}", 1), "utf-8")


def main() -> None:
    """Prepare, commit and tag."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("version", help="Version to release, such as 0.2.0.")
    version = parser.parse_args().version
    if subprocess.run(["git", "diff", "--quiet", "HEAD"], check=False, cwd=REPOSITORY).returncode:
        sys.exit("The checkout has changes; commit them first.")
    try:
        prepare(REPOSITORY, version, datetime.now(UTC).date())
    except ValueError as error:
        sys.exit(str(error))
    for command in (
        # The API document contains the version: install it, then hash the contract.
        ["make", ".venv/.installed", "schema"],
        ["git", "add", "--all"],
        ["git", "commit", "--quiet", "--message", f"Release {version}"],
        ["git", "tag", "--annotate", f"v{version}", "--message", f"Real2Sim {version}"],
    ):
        subprocess.run(command, check=True, cwd=REPOSITORY)
    print(f"Release {version} is committed and tagged; push it with git push --follow-tags")


if __name__ == "__main__":
    main()
