"""Encoders of a traffic set as plain torch modules: ``{ego, vehicles, mask}`` -> features.

Shapes: B = batch, N = rows of the padded set, M = real rows of one set, d1 = vehicle features,
d2 = ego features, d3 = ``code_dim``. Rows with mask 0 are padding: whatever they hold, even NaN,
reaches neither outputs nor gradients. M = 0 is legal everywhere.
"""

from __future__ import annotations

import difflib
from importlib import import_module

from esc_gym.encoders.base import DEFAULT_HIDDEN, SetEncoder, hidden_layers
from esc_gym.encoders.concatenating import APEncoder, FPEncoder
from esc_gym.encoders.pooling import (
    AttentionEncoder,
    ESCEncoder,
    ESCExpEncoder,
    MaxEncoder,
    MeanEncoder,
)

__all__ = [
    "DEFAULT_HIDDEN",
    "REPRESENTATIONS",
    "APEncoder",
    "AttentionEncoder",
    "ESCEncoder",
    "ESCExpEncoder",
    "FPEncoder",
    "MaxEncoder",
    "MeanEncoder",
    "SetEncoder",
    "hidden_layers",
    "representation",
]

REPRESENTATIONS: dict[str, type[SetEncoder]] = {
    "esc": ESCEncoder,
    "esc-exp": ESCExpEncoder,
    "fp": FPEncoder,
    "ap": APEncoder,
    "mean": MeanEncoder,
    "max": MaxEncoder,
    "attention": AttentionEncoder,
}


def representation(name: str) -> type[SetEncoder]:
    """The encoder class of a name in ``REPRESENTATIONS``, or of a path "module:Class"."""
    if name in REPRESENTATIONS:
        return REPRESENTATIONS[name]
    known = f"expected one of {', '.join(REPRESENTATIONS)}, or a path 'module:Class'"
    module, colon, attribute = name.partition(":")
    if not colon:
        near = difflib.get_close_matches(name, REPRESENTATIONS, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"unknown representation {name!r}: {known}{hint}")
    try:
        encoder = getattr(import_module(module), attribute)
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        raise ValueError(f"representation {name!r}: {error}; {known}") from error
    if not (isinstance(encoder, type) and issubclass(encoder, SetEncoder)):
        raise ValueError(f"representation {name!r}: expected a subclass of SetEncoder")
    return encoder
