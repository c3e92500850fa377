"""Turns a server's answers into models, and words the error about an answer of a newer server or another program."""

from __future__ import annotations

from typing import TypeVar

from pydantic import BaseModel, ValidationError

from livessl.errors import RunError

M = TypeVar("M", bound=BaseModel)


class NewerServerError(RunError):
    """A message or answer that this client cannot read, because the server is newer, or too old."""


class ForeignAnswerError(RunError):
    """An answer that is not of livessl, such as the page of a proxy."""


def read_answer(model: type[M], body: str | bytes, path: str) -> M:
    """Return the answer to `GET /api/v1/PATH`.

    Raises
    ------
    NewerServerError
        If it is JSON that this client cannot read.
    ForeignAnswerError
        If it is not JSON.
    """
    try:
        return model.model_validate_json(body)
    except ValidationError as error:
        raise unreadable(error, path) from error


def unreadable(error: ValidationError, path: str) -> RunError:
    """Return the error to raise for the answer to `GET /api/v1/PATH`."""
    fault = error.errors(include_url=False)[0]
    if fault["type"] == "json_invalid":
        what = f"{path}: expected an answer in JSON, got something else"
        return ForeignAnswerError(f"{what}; check that the address is that of a livessl server")
    where = ".".join(str(part) for part in fault["loc"])
    what = f"{path}: cannot read the answer: {where}: {fault['msg']}"
    return NewerServerError(f"{what}; update the older of the two, livessl here or the server, and check its address")
