"""A JSON Schema of deployment files: with it an editor completes and checks them."""

from __future__ import annotations

from typing import Any

from fls_flow.deploy.endpoints import PROTOCOLS
from fls_flow.deploy.read import MAX_SECONDS, MAX_THREADS, MAX_WINDOW
from fls_flow.deploy.settings import MODES

__all__ = ["schema"]

Schema = dict[str, Any]

NAME = {"pattern": r"^[A-Za-z_-][A-Za-z0-9_-]*$"}
TEXT: Schema = {"type": "string", "minLength": 1}
TEXTS: Schema = {"type": "array", "items": TEXT}
ENDPOINTS: Schema = {"type": "array", "items": {"type": "string", "pattern": f"^({'|'.join(PROTOCOLS)})/"}}
SECONDS: Schema = {"type": "number", "exclusiveMinimum": 0, "maximum": MAX_SECONDS}


def schema() -> Schema:
    """What a deployment file may hold, as a JSON Schema (draft 2020-12).

    A file that `check` finds sound fits it. It knows keys and values, but neither the graph nor which
    settings need each other.
    """
    tls = {"ca": TEXT, "certificate": TEXT, "key": TEXT, "mutual": {"type": "boolean"}}
    settings: dict[str, Schema] = {
        "mode": {"enum": list(MODES)},
        "listen": ENDPOINTS,
        "connect": ENDPOINTS,
        "tls": _keys(tls),
        "user": {**TEXT, "pattern": "^[^:]*$"},
        "password_file": TEXT,
        "access_control": _keys({"users": TEXTS, "certificates": TEXTS}),
        "open": {"type": "boolean"},
    }
    seconds = dict.fromkeys(("deadline_s", "lost_after_s", "connect_timeout_s"), SECONDS)
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "A deployment of fls_flow",
        **_keys(
            {
                "deployment": {**TEXT, **NAME},
                "window": _whole(MAX_WINDOW),
                "hosts": _named(_or_null(TEXTS)),
                "processes": _named(TEXTS),
                "qos": {"type": "object", "additionalProperties": {"enum": ["latest", "lossless"]}},
                "threads": _named(_whole(MAX_THREADS)),
                **seconds,
                "control": {"type": "boolean"},
                "zenoh": {
                    "type": "object",
                    "properties": {key: _or_null(one) for key, one in settings.items()},
                    "additionalProperties": {"$ref": "#/$defs/host"},  # by name: what lies over the rest
                },
            }
        ),
        "type": "object",
        "required": ["deployment"],
        "$defs": {"host": _keys(settings)},
    }


def _keys(known: dict[str, Schema]) -> Schema:
    """These keys and no others; null is as if a key were not there."""
    inside = {key: _or_null(one) for key, one in known.items()}
    return {"type": ["object", "null"], "properties": inside, "additionalProperties": False}


def _named(of: Schema) -> Schema:
    return {"type": "object", "propertyNames": NAME, "additionalProperties": of}


def _or_null(one: Schema) -> Schema:
    return {"anyOf": [one, {"type": "null"}]}


def _whole(most: int) -> Schema:
    return {"type": "integer", "minimum": 1, "maximum": most}
