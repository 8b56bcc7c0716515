from __future__ import annotations

import re
from hashlib import sha256
from pathlib import Path

import pytest

from real2sim_server.service.routes.server import FOLDER, STUDIO

OWN = sorted(name for name in STUDIO if not name.startswith("vendor/"))
"""Own files. Vendored files are unmodified."""
MODULES = [name for name in OWN if name.endswith(".js")]
IMPORT = re.compile(r'^import (?:\{([^}]*)\} )?from "\./([\w.]+)";', re.MULTILINE)
EXPORT = re.compile(r"^export (?:async )?(?:function\*?|const|let|class) (\w+)", re.MULTILINE)


def text(name: str) -> str:
    return (FOLDER / name).read_text()


def test_the_page_has_a_restrictive_content_security_policy(client):
    answer = client.get("/ui")
    assert answer.headers["content-type"].startswith("text/html")
    assert "default-src 'none'; script-src 'self'" in answer.headers["content-security-policy"]


def test_the_root_redirects_to_the_page(client):
    for path in ("/", "/ui"):
        answer = client.get(path, follow_redirects=False)
        assert (answer.status_code, answer.headers["location"]) == (307, "/ui/")


def test_the_page_needs_no_token_but_its_data_does(start_worker):
    client = start_worker(token="correct horse")
    assert client.get("/ui/").status_code == 200
    assert client.get("/v1/scenes").status_code == 401


def test_other_files_are_not_served(client):
    for name in ("../app.py", "..%2fapp.py", "nothing.js", "/etc/passwd"):
        answer = client.get(f"/ui/{name}")
        assert answer.status_code == 404, name


@pytest.mark.parametrize("name", MODULES)
def test_modules_import_only_exported_names(name):
    for names, module in IMPORT.findall(text(name)):
        exported = set(EXPORT.findall(text(module)))
        assert {n.strip() for n in names.split(",") if n.strip()} <= exported


def test_modules_are_served_as_javascript_and_under_600_lines(client):
    for name in MODULES:
        answer = client.get(f"/ui/{name}")
        assert answer.headers["content-type"].startswith("text/javascript"), name
        assert len(answer.text.splitlines()) < 600, name


def test_vendored_files_match_the_notices():
    notices = Path(__file__).parents[4].joinpath("THIRD_PARTY.md").read_text()
    stated = dict(re.findall(r"(?m)^\| (\S+) \| `([0-9a-f]{64})` \|$", notices))
    there = {
        path.relative_to(FOLDER / "vendor").as_posix(): sha256(path.read_bytes()).hexdigest()
        for path in (FOLDER / "vendor").rglob("*")
        if path.is_file()
    }
    assert there == stated
    assert {name.split("/")[0] for name in there if name.endswith("/LICENSE")} == {
        name.split("/")[0] for name in there
    }


@pytest.mark.parametrize("name", OWN)
def test_no_file_names_another_host(name):
    addresses = re.findall(r"https?://[\w.]+", text(name))
    assert [a for a in addresses if a != "http://www.w3.org"] == []


def test_every_element_used_by_a_module_exists():
    made = re.findall(r'\bid: "([\w-]+)"', "".join(map(text, MODULES)))
    pages = text("index.html") + text("fleet.html")
    there = set(re.findall(r'\bid="([\w-]+)"', pages)) | set(made)
    asked = re.findall(r'(?:\$|getElementById)\("([\w-]+)"\)', "".join(map(text, MODULES)))
    # The pose fields are created for each axis.
    assert {a for a in asked if not a.startswith("pose-")} <= there


def test_the_fleet_page_shows_fields_that_workers_report(client):
    page = client.get("/ui/fleet.html")
    assert page.status_code == 200
    assert 'src="fleet.js"' in page.text
    (worker,) = client.get("/v1/fleet").json()["workers"]
    shown = set(re.findall(r"worker\.(\w+)", text("fleet.js")))
    assert shown <= set(worker)
    assert {"sessions", "load", "queue", "scenes", "scene_sessions"} <= shown
