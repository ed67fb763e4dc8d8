"""Which network is meant."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, get_args

Variant = Literal["l", "s"]
Attention = Literal["eca", "se"]
Fusion = Literal["asff", "concat"]


@dataclass(frozen=True)
class NetworkConfig:
    """The network's variant and the switches of its ablations.

    Attributes:
        variant: trunk of MobileNetV3-Large or -Small.
        attention: of channels in the trunk: ECA, or the squeeze and excitation of the original MobileNetV3.
        fusion: of the three scales: ASFF, or concatenation.
    """

    variant: Variant = "l"
    attention: Attention = "eca"
    fusion: Fusion = "asff"

    def __post_init__(self) -> None:
        for name, choices in (("variant", Variant), ("attention", Attention), ("fusion", Fusion)):
            if getattr(self, name) not in get_args(choices):
                allowed = ", ".join(get_args(choices))
                raise ValueError(f"{name}: must be one of {allowed}, got {getattr(self, name)!r}")

    def to_dict(self) -> dict[str, str]:
        """What `from_dict` reads; plain JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> NetworkConfig:
        """The configuration that `to_dict` wrote.

        Raises:
            ValueError: a key that does not exist, or a value that is not allowed.
        """
        unknown = sorted(set(values) - {field.name for field in fields(cls)})
        if unknown:
            raise ValueError(f"network: has no {', '.join(unknown)}; it has variant, attention, fusion")
        return cls(**values)
