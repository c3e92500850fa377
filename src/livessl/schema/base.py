"""The base of all models of the API."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Model(BaseModel):
    """A model whose validator is built when it is first used: building all of them would double a client's start.

    Bodies of requests derive from `BaseModel` instead, because FastAPI wants their validators at once.
    """

    model_config = ConfigDict(defer_build=True)
