from __future__ import annotations

import re
from hashlib import sha256
from pathlib import Path
from urllib.parse import urljoin, urlsplit

import pytest
from fastapi.testclient import TestClient

from real2sim_server.service.routes.server import FOLDER, STUDIO

from .hands import behind

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
        assert (answer.status_code, answer.headers["location"]) == (307, "ui/")


def pages_from(client, entry):
    """Follow the links of a page; the paths that answer."""
    waiting, seen = [entry], {}
    while waiting:
        path = waiting.pop()
        answer = client.get(path)
        assert answer.status_code == 200, path
        seen[str(answer.url.path)] = answer.text
        if not answer.headers["content-type"].startswith("text/html"):
            continue
        for link in re.findall(r'(?:href|src)="([^"#?]+)"', answer.text):
            to = urljoin(str(answer.url), link)
            if (found := urlsplit(to).path) not in seen and found not in waiting:
                waiting.append(found)
    return seen


@pytest.mark.parametrize("forwarded", [False, True])
def test_pages_work_below_the_path_of_a_proxy(client, forwarded):
    proxied = TestClient(
        behind(client.app, "/sim", forwarded=forwarded), base_url=str(client.base_url)
    )
    seen = pages_from(proxied, "/sim/")
    assert {"/sim/ui/", "/sim/ui/main.js", "/sim/ui/studio.css"} <= seen.keys()
    assert {"/sim/docs", "/sim/ui/docs.css", "/sim/openapi.json"} <= pages_from(
        proxied, "/sim/docs"
    ).keys()


def test_a_proxy_that_names_its_path_gets_addresses_below_it(client):
    proxied = TestClient(behind(client.app, "/sim", forwarded=True), base_url=str(client.base_url))
    made = proxied.post("/sim/v1/sessions?scene=tiny")
    name = made.json()["session_id"]
    assert made.headers["Location"] == f"/sim/v1/sessions/{name}"
    host = client.base_url.netloc.decode()
    assert made.json()["ws_url"] == f"ws://{host}/sim/v1/sessions/{name}/drive"
    headers = {"Authorization": f"Bearer {made.json()['token']}"}
    assert proxied.get(made.headers["Location"], headers=headers).status_code == 200


@pytest.mark.parametrize("given", ["//other.example", "/a b", "sim", "/sim/../x?y", "/\u00e4"])
def test_other_prefixes_are_ignored(client, given):
    answer = client.post(
        "/v1/scenarios", json={"scene": "tiny"}, headers={"X-Forwarded-Prefix": given.encode()}
    )
    assert answer.headers["Location"].startswith("/v1/scenarios/")


@pytest.mark.parametrize("name", OWN)
def test_no_file_holds_an_address_from_the_root_of_the_host(name):
    content = text(name)
    assert re.findall(r'(?:href|src)="/|url\(["\']?/|from "/|import\("/', content) == []
    if name.endswith(".js"):
        # Paths of the REST interface are appended to the address of the worker.
        assert "location.origin" not in content
        assert "location.host" not in content
        assert re.findall(r"fetch\((?!WORKER \+)", content) == []
        assert re.findall(r"new WebSocket\((?!`\$\{base\})", content) == []


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
