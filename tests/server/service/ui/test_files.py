from __future__ import annotations

import re

import pytest

from real2sim_server.service.routes.ui import FOLDER, STUDIO

MODULES = sorted(name for name in STUDIO if name.endswith(".js"))
IMPORT = re.compile(r'^import (?:\{([^}]*)\} )?from "\./([\w.]+)";', re.MULTILINE)
EXPORT = re.compile(r"^export (?:async )?(?:function\*?|const|let|class) (\w+)", re.MULTILINE)


def text(name: str) -> str:
    return (FOLDER / name).read_text()


def test_the_page_is_served_with_a_policy_that_allows_nothing_from_elsewhere(client):
    answer = client.get("/ui")
    assert answer.headers["content-type"].startswith("text/html")
    assert "default-src 'none'; script-src 'self'" in answer.headers["content-security-policy"]


@pytest.mark.parametrize("path", ["/", "/ui"])
def test_the_root_leads_to_the_page(client, path):
    answer = client.get(path, follow_redirects=False)
    assert (answer.status_code, answer.headers["location"]) == (307, "/ui/")


def test_the_page_needs_no_token_and_its_data_does(start_worker):
    client = start_worker(token="correct horse")
    assert client.get("/ui/").status_code == 200
    assert client.get("/v1/scenes").status_code == 401


@pytest.mark.parametrize("name", ["../app.py", "..%2fapp.py", "nothing.js", "/etc/passwd"])
def test_other_files_are_not_served(client, name):
    answer = client.get(f"/ui/{name}")
    assert answer.status_code == 404, answer.text


@pytest.mark.parametrize("name", MODULES)
def test_a_module_imports_only_what_another_exports(name):
    for names, module in IMPORT.findall(text(name)):
        exported = set(EXPORT.findall(text(module)))
        assert {n.strip() for n in names.split(",") if n.strip()} <= exported


@pytest.mark.parametrize("name", MODULES)
def test_a_module_is_served_as_javascript_and_short(client, name):
    answer = client.get(f"/ui/{name}")
    assert answer.headers["content-type"].startswith("text/javascript")
    assert len(answer.text.splitlines()) < 300


@pytest.mark.parametrize("name", sorted(STUDIO))
def test_no_file_names_another_host(name):
    addresses = re.findall(r"https?://[\w.]+", text(name))
    assert [a for a in addresses if a != "http://www.w3.org"] == []


def test_every_element_that_a_module_asks_for_exists():
    made = re.findall(r'\bid: "([\w-]+)"', "".join(map(text, MODULES)))
    there = set(re.findall(r'\bid="([\w-]+)"', text("index.html"))) | set(made)
    asked = re.findall(r'(?:\$|getElementById)\("([\w-]+)"\)', "".join(map(text, MODULES)))
    # Fields of the pose are made one for each axis.
    assert {a for a in asked if not a.startswith("pose-")} <= there
