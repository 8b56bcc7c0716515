"""How the site is built: ``python -m sphinx -W --keep-going docs site``.

Pages are the Markdown files beside this one. README, ARCHITECTURE, CONTRIBUTING and CHANGELOG stand
at the root of the repository, where people look for them; the site shows them as pages, with their
links turned to where the pages are.
"""

from __future__ import annotations

import functools
import inspect
import operator
import os
import posixpath
import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic_core import PydanticUndefined
from sphinx.application import Sphinx

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(REPOSITORY / folder) for folder in ("proto", "client", "server", "benchmarks")]
# What autodoc imports must not look for a device.
os.environ.setdefault("CUDA_VISIBLE_DEVICES", "")

import real2sim  # noqa: E402 - of this checkout
from real2sim.version import VERSION  # noqa: E402
from real2sim_proto.schema import write_schemas  # noqa: E402
from real2sim_server.service.app import openapi_text  # noqa: E402

project = "Real2Sim"
author = "the Real2Sim authors"
version = release = VERSION

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
]
templates_path = ["_templates"]
exclude_patterns = ["_templates", "Thumbs.db", ".DS_Store"]
default_role = "code"
smartquotes = False
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}

myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]

# Short names of types stand in several packages; which of them a link means is seldom in doubt.
suppress_warnings = ["ref.python"]

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_default_options = {"exclude-members": "model_config"}
autodoc_type_aliases = {name: name for name in ("Operation", "Plan")}
python_maximum_signature_line_length = 88
napoleon_use_ivar = True
napoleon_use_rtype = False
napoleon_preprocess_types = False
toc_object_entries_show_parents = "hide"

html_theme = "furo"
html_title = f"Real2Sim {VERSION}"
html_show_copyright = False
html_copy_source = False

ROOT_PAGES = {
    "index": "README.md",
    "site/architecture": "ARCHITECTURE.md",
    "site/contributing": "CONTRIBUTING.md",
    "site/changelog": "CHANGELOG.md",
    "site/security": "SECURITY.md",
    "site/third_party": "THIRD_PARTY.md",
}
"""Pages of the site that show a file at the root of the repository, before their own text."""

SHOWN_AS = {file: f"docs/{page}.md" for page, file in ROOT_PAGES.items()}

ALIAS = re.compile(r"TypeAliasForwardRef\('(\w+)'\)")
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s#]+)(#[^)\s]*)?\)")


def setup(app: Sphinx) -> None:
    """Hooks of the build."""
    app.connect("source-read", show_root_page)
    app.connect("autodoc-process-docstring", list_fields)
    app.connect("autodoc-process-signature", show_signature)
    app.connect("autodoc-skip-member", skip_constrained)
    app.connect("build-finished", write_contract)
    for name in real2sim.__all__:
        # Links tell where a class is defined, which is in private modules.
        if inspect.isclass(value := getattr(real2sim, name)):
            value.__module__ = "real2sim"


def write_contract(app: Sphinx, error: Exception | None) -> None:
    """Put the schemas of all messages and the OpenAPI document on the site."""
    if error is None:
        write_schemas(Path(app.outdir) / "schema")
        (Path(app.outdir) / "openapi.json").write_text(openapi_text())


def show_root_page(app: Sphinx, page: str, text: list[str]) -> None:
    """Put the root's file into its page, and turn links that leave the folder of the site."""
    here = posixpath.dirname(f"docs/{page}")
    own = turned_links(text[0], origin=here, here=here)
    if (file := ROOT_PAGES.get(page)) is not None:
        app.env.note_dependency(str(REPOSITORY / file))
        own = turned_links((REPOSITORY / file).read_text("utf-8"), origin="", here=here) + own
    text[0] = own


def turned_links(text: str, *, origin: str, here: str) -> str:
    """The text with relative links as they must be on a page of the folder ``here``.

    Args:
        text: Markdown.
        origin: folder that its links are relative to, from the root of the repository.
        here: folder of the page, from the root of the repository.
    """

    def turned(link: re.Match[str]) -> str:
        mark, label, target, anchor = link.groups()
        if ":" in target:
            return link.group()
        path = posixpath.normpath(posixpath.join(origin, target))
        path = SHOWN_AS.get(path, path)
        if not path.startswith("docs/"):
            # Nothing on the site shows this file.
            return label
        return f"{mark}[{label}]({posixpath.relpath(path, here)}{anchor or ''})"

    return LINK.sub(turned, text)


def list_fields(  # noqa: PLR0917 - as Sphinx calls it
    app: Sphinx, what: str, name: str, value: Any, options: Any, lines: list[str]
) -> None:
    """Add a message's fields to what its docstring says."""
    if not (inspect.isclass(value) and issubclass(value, BaseModel) and value.model_fields):
        return
    own = {n: f for n, f in value.model_fields.items() if n not in inherited_fields(value)}
    lines.append("")
    for field_name, field in own.items():
        kind = inspect.formatannotation(bare(field.annotation)).replace("real2sim_proto.", "")
        kind = re.sub(r"\b(?:typing|types|annotated_types)\.|\w+\.(?=[A-Z])", "", kind)
        given = field.get_default(call_default_factory=False)
        default = "" if given is PydanticUndefined else f", default ``{short(given)}``"
        description = f": {field.description}" if field.description else ""
        lines.append(f"* ``{field_name}`` (``{short(kind)}``{default}){description}")
    lines.append("")


def bare(annotation: Any) -> Any:
    """A type without the limits of its values."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return bare(inner[0])
    if origin in (None, Literal, Callable):
        return annotation
    parts = tuple(bare(part) for part in inner)
    return functools.reduce(operator.or_, parts) if origin in (Union, UnionType) else origin[parts]


def inherited_fields(model: type[BaseModel]) -> set[str]:
    """Fields that a message shares with all others."""
    return {"v", "id"} if {"v", "type", "id"} <= set(model.model_fields) else set()


def short(value: Any) -> str:
    """A value as text of bounded length."""
    text = value if isinstance(value, str) and "[" in value else repr(value)
    text = value if isinstance(value, str) and not text.startswith("'") else text
    return text if len(text) <= 70 else f"{text[:67]}..."


def skip_constrained(  # noqa: PLR0917 - as Sphinx calls it
    app: Sphinx, what: str, name: str, value: Any, skip: bool, options: Any
) -> bool | None:
    """Leave out types with limits: fields tell them, and alone they show pydantic's objects."""
    return True if get_origin(value) is Annotated else None


def show_signature(  # noqa: PLR0917 - as Sphinx calls it
    app: Sphinx, what: str, name: str, value: Any, options: Any, signature: Any, returns: Any
) -> tuple[str, str | None] | None:
    """A signature without Sphinx's own names; none of a class that users do not make.

    A message is made of its fields, which are listed below its name, and a handle by a client.
    """
    if inspect.isclass(value):
        by_client = re.match(r"\((transport|scenario): ", signature or "")
        if by_client or issubclass(value, BaseModel):
            return "", None
    return None if signature is None else (ALIAS.sub(r"\1", signature), returns)
