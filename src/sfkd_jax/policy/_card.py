"""The model card of a policy on the Hub: how to load it, and what is known about it."""

from __future__ import annotations

import math

from sfkd_jax.certificate import Certificate

CARD = "README.md"
"""The file that the Hub shows."""

_HEAD = """---
library_name: sfkd_jax
license: {license}
pipeline_tag: robotics
tags:
- control
- jax
---

# {name}

A learned controller, made with sfkd_jax.

## How to load it

```bash
pip install "sfkd-jax[hub]"
```

```python
import sfkd_jax

policy = sfkd_jax.load("{address}")
```

`load` compares hashes of weights, settings and certificate, and repeats the proof. A
commit after `@` in the address stands for one version.

## What it says about itself

```text
{printed}
```
"""
_CERTIFIED = """
## What is proved

The learned model contracts: at every step the distance between two of its predictions
shrinks to {alpha:.4f} of what it was, or less, for every environment in its box. The
proof is about the float32 weights in this repository, and `load` checks it again.

## What is measured

The other numbers above. Bounds hold with a probability of {level:g} %, unless the text
states another one, on runs like those that were measured.
{signer}

## Under which conditions

Those that the text states: its boxes, and the ranges in which reference and environment
change. `info.claim` says at every step which bound holds, or why none does. Nothing is
claimed outside of these conditions, and nothing about a machine on which no runs were
measured.
"""
_UNCERTIFIED = """
## What is proved, and what is measured

Nothing: this policy has no certificate.
"""


def model_card(
    printed: str, certificate: Certificate | None, address: str, license: str
) -> str:
    """Return the text of the card.

    Args:
        printed: what the policy prints about itself.
        certificate: its verified certificate, or None.
        address: on the Hub, "hf://owner/name".
        license: identifier of a licence.
    """
    head = _HEAD.format(
        name=address.rpartition("/")[2],
        address=address,
        license=license,
        printed=printed,
    )
    if certificate is None:
        return head + _UNCERTIFIED
    signer = "The certificate is unsigned: nobody vouches for what was measured."
    if certificate.signature is not None:
        key = certificate.signature.public_key
        signer = f"Who holds the key {key} vouches for them, see `signed_by` of `load`."
    return head + _CERTIFIED.format(
        # Rounded up, since it is a bound.
        alpha=math.ceil(1e4 * certificate.proof.alpha) / 1e4,
        level=100.0 * certificate.measured.d_bar.level,
        signer=signer,
    )
