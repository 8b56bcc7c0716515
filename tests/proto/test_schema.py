from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import referencing

from real2sim_proto.schema import SHARED, schema_text, schemas

HASHES = Path(__file__).resolve().parents[2] / "proto" / "contract.sha256"


@cache
def made() -> dict[str, dict[str, Any]]:
    """Schemas of the models."""
    return schemas()


def test_schemas_match_the_recorded_hashes():
    lines = (line.split() for line in HASHES.read_text("utf-8").splitlines())
    recorded = {Path(name).stem: digest for digest, name in lines if name.startswith("schema/")}
    texts = {name: schema_text(schema) for name, schema in made().items()}
    hashes = {name: hashlib.sha256(text.encode()).hexdigest() for name, text in texts.items()}
    assert hashes == recorded, "run `make schema` if the contract is meant to change"


def test_every_schema_is_valid_json_schema():
    for schema in made().values():
        jsonschema.Draft202012Validator.check_schema(schema)


def validator(name: str) -> jsonschema.Draft202012Validator:
    """A validator as used with the schema folder, where references point to sibling files."""
    files = {f"{name}.json": referencing.Resource.from_contents(s) for name, s in made().items()}
    registry = referencing.Registry().with_resources(files.items())
    return jsonschema.Draft202012Validator(made()[name], registry=registry)


def test_the_schema_of_an_operation_refuses_unknown_members():
    operation = validator("Operation")
    operation.validate({"op": "translate", "object_id": "car_1", "y": 3.2})
    with pytest.raises(jsonschema.ValidationError):
        operation.validate({"op": "translate", "object_id": "car_1", "y": 3.2, "w": 1})


def test_a_reference_to_the_storyboard_schema_is_resolved():
    operation = validator("Operation")
    operation.validate({"op": "set_storyboard", "storyboard": {"entities": [{"name": "Ego"}]}})
    with pytest.raises(jsonschema.ValidationError):
        operation.validate({"op": "set_storyboard", "storyboard": {"entities": [{"nam": "Ego"}]}})


def test_shared_definitions_are_only_in_their_own_file():
    for name, schema in made().items():
        assert set(SHARED).isdisjoint(schema.get("$defs", {})), name
