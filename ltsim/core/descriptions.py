"""Descriptions of the fields of pydantic models: the docstrings below the fields, read only when they are used.

Pydantic's `use_attribute_docstrings` reads the source of each class when it is created, which takes a tenth of the time
that a command needs to start; only schemas, tables and pages show descriptions.
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
    """Base of models whose JSON schema holds the docstrings below the fields as descriptions."""

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """JSON schema of the model with the descriptions of its fields."""
        reference = handler(core_schema)
        properties: dict[str, Any] = handler.resolve_ref_schema(reference).get("properties", {})
        meanings = descriptions(cls)
        for name, field in cls.model_fields.items():
            entry = properties.get(name) or properties.get(field.alias or name)
            if entry is not None and name in meanings:
                entry.setdefault("description", meanings[name])
        return reference


def descriptions(model: type[BaseModel]) -> dict[str, str]:
    """Descriptions of the fields of a model by field name; fields of base classes are included."""
    meanings: dict[str, str] = {}
    for kind in reversed(model.__mro__):
        if issubclass(kind, BaseModel) and kind is not BaseModel:
            meanings |= _docstrings(kind.__module__).get(kind.__qualname__, {})
    return meanings | {name: field.description for name, field in model.model_fields.items() if field.description}


@cache
def _docstrings(module_name: str) -> dict[str, dict[str, str]]:
    """Docstrings below the annotated names of each class of a module, by the qualified name of the class."""
    try:
        tree = ast.parse(inspect.getsource(sys.modules[module_name]))
    except (OSError, TypeError):  # no source is at hand, as in an interactive session
        return {}
    return dict(_descriptions_of_classes(tree.body, ""))


def _descriptions_of_classes(statements: list[ast.stmt], prefix: str) -> list[tuple[str, dict[str, str]]]:
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
            classes += [(prefix + node.name, texts), *_descriptions_of_classes(node.body, f"{prefix}{node.name}.")]
    return classes
