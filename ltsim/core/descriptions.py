"""Descriptions of the fields of pydantic models, from the docstrings below the fields.

The docstrings are read only when a schema, a table or a page shows them. Pydantic's `use_attribute_docstrings` would
read the source of each class when the class is created, which takes a tenth of the time that a command needs to start.
"""

from __future__ import annotations

import ast
import inspect
import sys
from functools import cache
from itertools import pairwise
from typing import Any

from pydantic import BaseModel, GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema


class DescribedModel(BaseModel):
    """Base class of models whose JSON schema contains the docstrings below the fields as descriptions."""

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """JSON schema of the model with the descriptions of its fields."""
        reference = handler(core_schema)
        properties: dict[str, Any] = handler.resolve_ref_schema(reference).get("properties", {})
        meanings = field_descriptions(cls)
        for name, field in cls.model_fields.items():
            entry = properties.get(name) or properties.get(field.alias or name)
            if entry is not None and name in meanings:
                entry.setdefault("description", meanings[name])
        return reference


def field_descriptions(model: type[BaseModel]) -> dict[str, str]:
    """Description of each field of a model and of its base classes, by the name of the field."""
    meanings: dict[str, str] = {}
    for kind in reversed(model.__mro__):
        if issubclass(kind, BaseModel) and kind is not BaseModel:
            meanings |= _attribute_docstrings(kind.__module__).get(kind.__qualname__, {})
    return meanings | {name: field.description for name, field in model.model_fields.items() if field.description}


@cache
def _attribute_docstrings(module_name: str) -> dict[str, dict[str, str]]:
    """Docstrings of annotated attributes by attribute name, for each class of a module by its qualified name."""
    try:
        tree = ast.parse(inspect.getsource(sys.modules[module_name]))
    except (OSError, TypeError):  # no source is at hand, as in an interactive session
        return {}
    return dict(_attribute_docstrings_of_classes(tree.body, ""))


def _attribute_docstrings_of_classes(statements: list[ast.stmt], name_prefix: str) -> list[tuple[str, dict[str, str]]]:
    """Pairs of the qualified name of a parsed class and the docstrings of its annotated attributes by attribute name.

    `name_prefix` is the qualified name of the enclosing class with a dot, or empty.
    """
    classes = []
    for node in statements:
        if isinstance(node, ast.ClassDef):
            texts = {
                first.target.id: inspect.cleandoc(second.value.value)
                for first, second in pairwise(node.body)
                if isinstance(first, ast.AnnAssign) and isinstance(first.target, ast.Name)
                if isinstance(second, ast.Expr) and isinstance(second.value, ast.Constant)
                if isinstance(second.value.value, str)
            }
            classes += [
                (name_prefix + node.name, texts),
                *_attribute_docstrings_of_classes(node.body, f"{name_prefix}{node.name}."),
            ]
    return classes
