"""The calls as one page of HTML, made of the OpenAPI document, without any script."""

from __future__ import annotations

import json
from collections.abc import Iterator
from html import escape
from itertools import groupby
from typing import Any

from .openapi import operations

STYLE = "/ui/docs.css"
POLICY = (
    "default-src 'none'; style-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
"""Content security policy of the page."""


def reference_page(made: dict[str, Any]) -> str:
    """The page of a document."""
    info = made["info"]
    found = sorted(operations(made), key=lambda found: _tag(found[2]))
    tags = [(tag, list(group)) for tag, group in groupby(found, key=lambda found: _tag(found[2]))]
    return "\n".join(
        (
            "<!doctype html>",
            '<html lang="en"><head><meta charset="utf-8">',
            f"<title>{escape(info['title'])}</title>",
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f'<link rel="stylesheet" href="{STYLE}"></head><body>',
            f"<h1>{escape(info['title'])} <small>{escape(info['version'])}</small></h1>",
            '<p>The same for programs: <a href="/openapi.json">openapi.json</a>. In the examples '
            "<code>$WORKER</code> is the address of this worker, <code>$REAL2SIM_TOKEN</code> its "
            "token, if it has one, and <code>$SESSION_TOKEN</code> the <code>token</code> in the "
            "answer that made the session.</p>",
            "<nav>",
            *(f'<a href="#{escape(tag)}">{escape(tag)}</a>' for tag, _ in tags),
            "</nav>",
            *(line for tag, group in tags for line in _section(tag, group)),
            "<h2>Schemas</h2>",
            *_schemas(made["components"]["schemas"]),
            "</body></html>",
        )
    )


def _section(tag: str, group: list[tuple[str, str, dict[str, Any]]]) -> Iterator[str]:
    yield f'<h2 id="{escape(tag)}">{escape(tag)}</h2>'
    for path, method, operation in group:
        yield f'<details id="{escape(operation["operationId"])}"><summary>'
        yield f"<b>{method.upper()}</b> <code>{escape(path)}</code> "
        yield f"{escape(operation.get('summary', ''))}</summary>"
        yield f"<p>{escape(operation.get('description', ''))}</p>"
        yield from _parameters(operation.get("parameters", ()))
        yield from _contents("Body", operation.get("requestBody", {}).get("content", {}))
        yield "<table><tr><th>status</th><th>answer</th></tr>"
        for status, response in sorted(operation["responses"].items()):
            kinds = ", ".join(response.get("content", ()))
            described = escape(f"{response.get('description', '')}")
            yield f"<tr><td>{status}</td><td>{described} <i>{escape(kinds)}</i></td></tr>"
        yield f"</table><pre>{escape(operation['x-codeSamples'][0]['source'])}</pre></details>"


def _parameters(parameters: Any) -> Iterator[str]:
    if not parameters:
        return
    yield "<table><tr><th>parameter</th><th>in</th><th>meaning</th></tr>"
    for parameter in parameters:
        name = escape(parameter["name"]) + (" *" if parameter.get("required") else "")
        meaning = escape(parameter.get("description", ""))
        schema = escape(_kind(parameter.get("schema", {})))
        yield f"<tr><td><code>{name}</code></td><td>{escape(parameter['in'])}</td>"
        yield f"<td>{meaning} <i>{schema}</i></td></tr>"
    yield "</table>"


def _contents(title: str, contents: dict[str, Any]) -> Iterator[str]:
    for kind, content in contents.items():
        yield f"<p>{title}: <code>{escape(kind)}</code> {_linked(content.get('schema', {}))}</p>"
        if "example" in content:
            yield f"<pre>{escape(json.dumps(content['example'], indent=1))}</pre>"


def _schemas(schemas: dict[str, Any]) -> Iterator[str]:
    for name, schema in sorted(schemas.items()):
        yield f'<details id="schema-{escape(name)}"><summary><code>{escape(name)}</code></summary>'
        yield f"<p>{escape(schema.get('description', ''))}</p>"
        yield f"<pre>{escape(json.dumps(schema, indent=1))}</pre></details>"


def _linked(schema: dict[str, Any]) -> str:
    name = _reference(schema)
    return f'<a href="#schema-{escape(name)}">{escape(name)}</a>' if name else ""


def _kind(schema: dict[str, Any]) -> str:
    choices = schema.get("anyOf", [schema])
    kinds = [str(c.get("type") or _reference(c) or "") for c in choices]
    return " or ".join(kind for kind in kinds if kind and kind != "null")


def _reference(schema: dict[str, Any]) -> str:
    choices = [schema, *schema.get("anyOf", ())]
    return next((c["$ref"].rsplit("/", 1)[1] for c in choices if "$ref" in c), "")


def _tag(operation: dict[str, Any]) -> str:
    return str(operation.get("tags", ["worker"])[0])
