"""YAML as people write it, in files and on the command line, with the scalars of YAML 1.2.

There 1e-3 is a number, which PyYAML takes for text; 1:30, 010 and yes are text, which it takes for
90, 8 and true.
"""

from __future__ import annotations

import re
from typing import Annotated, Any

import yaml
from tyro.constructors import PrimitiveConstructorSpec


class _Loader(yaml.SafeLoader):
    """Refuses a key that stands twice in a mapping, of which YAML takes the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        names = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        for name in names:
            if names.count(name) > 1:
                raise yaml.YAMLError(f"{name!r} stands there twice")
        return super().construct_mapping(node, deep)


class _Dumper(yaml.SafeDumper):
    """Quotes a text that would be read as a number."""


_SCALARS = {
    "tag:yaml.org,2002:bool": re.compile(r"(true|True|TRUE|false|False|FALSE)$"),
    "tag:yaml.org,2002:int": re.compile(r"[-+]?(0|[1-9][0-9_]*|0x[0-9a-fA-F]+)$"),
    "tag:yaml.org,2002:float": re.compile(
        r"[-+]?(\.[0-9]+|[0-9][0-9_]*(\.[0-9_]*)?)[eE][-+]?[0-9]+$"
        r"|[-+]?(\.[0-9]+|[0-9][0-9_]*\.[0-9_]*|\.(inf|Inf|INF))$|\.(nan|NaN|NAN)$"
    ),
}
for _each in (_Loader, _Dumper):
    _each.yaml_implicit_resolvers = {
        first: [(tag, form) for tag, form in resolvers if tag not in _SCALARS]
        for first, resolvers in _each.yaml_implicit_resolvers.items()
    }
    for _tag, _form in _SCALARS.items():
        _each.add_implicit_resolver(_tag, _form, list("-+.0123456789tTfF"))


def parse(text: str) -> Any:
    """The value of a YAML text. Raises yaml.YAMLError."""
    try:
        return yaml.load(text, _Loader)  # a SafeLoader: nothing of the text runs
    except ValueError as error:  # of a scalar that only looks like one: 2020-13-45
        raise yaml.YAMLError(str(error)) from error
    except (KeyError, IndexError) as error:  # of one that is said to be what it is not: !!bool 2
        raise yaml.YAMLError("a value is not of the type that its tag says") from error


def dump(value: Any) -> str:
    """YAML that ``parse`` reads back, keys in their order."""
    return yaml.dump(value, Dumper=_Dumper, sort_keys=False, allow_unicode=True)


def flow(value: Any) -> str:
    """YAML on one line."""
    text = yaml.dump(value, Dumper=_Dumper, default_flow_style=True, sort_keys=False, width=10**6)
    return text.strip().removesuffix("\n...")  # YAML's end of a bare number or word


def _from_yaml(words: list[str]) -> Any:
    try:
        return parse(words[0])
    except yaml.YAMLError as error:
        reason = str(error).splitlines()[0]
        raise ValueError(
            f"expected YAML such as '{{key: value}}', got {words[0]!r}: {reason}"
        ) from error


# On the command line a mapping is one YAML argument: --env-config '{lanes_count: 3}'.
YAML_ARGUMENT = PrimitiveConstructorSpec(
    nargs=1,
    metavar="YAML",
    instance_from_str=_from_yaml,
    is_instance=lambda value: isinstance(value, dict),
    str_from_instance=lambda value: [flow(value)],
)
Mapping = Annotated[dict[str, Any], YAML_ARGUMENT]
