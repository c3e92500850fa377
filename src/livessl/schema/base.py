"""The base of all models of the API."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Model(BaseModel):
    """A model whose validator is built when it is first used: building all of them would double a client's start."""

    model_config = ConfigDict(defer_build=True)
