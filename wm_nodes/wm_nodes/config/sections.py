"""What the sections of both loops' settings are made of."""

from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field

PositiveInt = Annotated[int, Field(ge=1)]
NonNegativeInt = Annotated[int, Field(ge=0)]
PositiveFloat = Annotated[float, Field(gt=0)]
NonNegativeFloat = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]


class SettingsSection(BaseModel):
    """Frozen, and every unknown key is an error; the string under a field is its `description`."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    def with_values(self, **values: Any) -> Self:
        """A copy with other values, checked as those of a preset are."""
        return self.model_validate({**dict(self), **values})
