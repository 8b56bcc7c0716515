from __future__ import annotations

from pathlib import Path

import jsonschema
import pytest

from real2sim_proto.schema import schema_text, schemas

SCHEMAS = schemas()
FOLDER = Path(__file__).resolve().parents[2] / "proto" / "schema"


def test_committed_schemas_are_those_of_the_models():
    committed = {p.stem: p.read_text(encoding="utf-8") for p in FOLDER.glob("*.json")}
    generated = {name: schema_text(schema) for name, schema in SCHEMAS.items()}
    assert committed == generated, "run `make schema` and commit proto/schema"


@pytest.mark.parametrize("name", sorted(SCHEMAS))
def test_every_schema_is_valid_json_schema(name):
    jsonschema.Draft202012Validator.check_schema(SCHEMAS[name])


def test_a_schema_refuses_what_the_model_refuses():
    validator = jsonschema.Draft202012Validator(SCHEMAS["Operation"])
    validator.validate({"op": "translate", "object_id": "car_1", "y": 3.2})
    with pytest.raises(jsonschema.ValidationError):
        validator.validate({"op": "translate", "object_id": "car_1", "y": 3.2, "w": 1})
