"""What the sections of both loops' settings are made of."""

import re
from typing import Annotated, Any, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

PositiveInt = Annotated[int, Field(ge=1)]
NonNegativeInt = Annotated[int, Field(ge=0)]
PositiveFloat = Annotated[float, Field(gt=0)]
NonNegativeFloat = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]


def _module_and_callable(text: str) -> str:
    if not re.fullmatch(r"[\w.]+:\w+", text):
        raise ValueError("a factory is written module:callable")
    return text


FactoryName = Annotated[str, AfterValidator(lambda text: text and _module_and_callable(text))]
"""module:callable of a package on PYTHONPATH, see core/imports.py; or empty."""
EnvironmentName = Annotated[
    str, AfterValidator(lambda text: text if text.isidentifier() else _module_and_callable(text))
]
"""One of environments/registry.py, or module:callable(config, num_envs, seed) -> Environment."""


class SettingsSection(BaseModel):
    """Frozen, and every unknown key is an error; the string under a field explains it (apps/help)."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    def with_values(self, **values: Any) -> Self:
        """A copy with other values, checked as those of a preset are."""
        return self.model_validate({**dict(self), **values})
