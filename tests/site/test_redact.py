"""Secrets in site files and texts are hidden, and nothing else is."""

from __future__ import annotations

import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from livessl.site.redact import HIDDEN, redacted, scrubbed
from small_site import small

SECRETS = st.integers(0, 2**64).map(lambda number: f"zq{number:017x}-_")

PLACES: dict[str, str] = {
    "server.events_db": "postgresql://livessl:{}@db.example/livessl",
    "alerts.actions.a.webhook.url": "https://hooks.example/services/{}",
    "alerts.actions.b.webhook.secret": "{}",
    "alerts.actions.c.mqtt.password": "{}",
    "alerts.actions.d.mqtt.username": "{}",
    "alerts.actions.e.webhook.url": "https://hooks.example/?key={}",
    "alerts.actions.f.pasword_of_the_hall": "{}",
    "token": "{}",
}
"""Keys whose values may hold a secret, those included that the site file does not have."""


@settings(max_examples=15)
@given(st.dictionaries(st.sampled_from(sorted(PLACES)), SECRETS, min_size=1))
def test_no_secret_is_left_in_the_site_file_or_in_a_text_that_repeats_it(secrets: dict[str, str]) -> None:
    data = small({place: PLACES[place].format(secret) for place, secret in secrets.items()})
    shown, taken = redacted(data)
    text = json.dumps(shown)
    said = " ".join(f"cannot reach {PLACES[place].format(secret)}, says {secret}!" for place, secret in secrets.items())
    for secret in secrets.values():
        assert secret not in text
        assert secret not in scrubbed(said, taken)


def test_what_is_no_secret_stays() -> None:
    data = small(
        {
            "server.events_db": "events.sqlite",
            "alerts.actions.a.command": ["/usr/bin/ring", "--pin", "1234"],
            "alerts.actions.b.webhook.url": "http://127.0.0.1:8080",
        }
    )
    shown, taken = redacted(data)
    assert taken == {"--pin", "1234"}
    assert shown["alerts"]["actions"]["a"]["command"] == ["/usr/bin/ring", HIDDEN, HIDDEN]
    data["alerts"]["actions"]["a"]["command"] = shown["alerts"]["actions"]["a"]["command"]
    assert shown == data


@pytest.mark.parametrize(
    ("text", "secret"),
    [
        ("refused livessl_Ab3-defghijklmnopqrstuvwxyz012345678901234567", "livessl_Ab3"),
        ("Authorization: Bearer eyJhbGciOi.J9", "eyJhbGciOi"),
        ("cannot connect to postgresql://me:pw@db/x", "pw@"),
        ("signed with whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw", "MfKQ"),
    ],
)
def test_what_looks_like_a_secret_is_hidden_in_any_text(text: str, secret: str) -> None:
    assert secret not in scrubbed(text)
    assert HIDDEN in scrubbed(text)


@pytest.mark.parametrize("word", ["livessl", "services", "small", "North"])
def test_users_and_paths_that_are_ordinary_words_leave_no_holes_in_other_texts(word: str) -> None:
    data = small(
        {
            "server.events_db": f"postgresql://{word}:zq17@db.example/{word}",
            "alerts.actions.a.mqtt.username": word,
            "alerts.actions.b.command": ["/usr/bin/ring", word],
        }
    )
    shown, taken = redacted(data)
    assert scrubbed(f"{word} has started", taken) == f"{word} has started"
    assert taken == {"zq17"}
    assert shown["server"]["events_db"] == "postgresql://db.example/…"
    assert shown["alerts"]["actions"]["a"]["mqtt"]["username"] == HIDDEN


@settings(max_examples=20)
@given(SECRETS)
def test_secrets_in_commands_and_below_secret_keys_are_hidden(secret: str) -> None:
    shown, taken = redacted(
        {
            "action": {"command": f"/usr/bin/ring --pin {secret}"},
            "password": {"value": secret, "others": [{"old": secret}], "pin": 7391},
            "bell": {"command": "/usr/bin/ring"},
        }
    )
    assert shown["action"]["command"] == f"/usr/bin/ring {HIDDEN}"
    assert shown["password"] == {"value": HIDDEN, "others": [{"old": HIDDEN}], "pin": HIDDEN}
    assert shown["bell"]["command"] == "/usr/bin/ring"
    assert secret not in scrubbed(f"tried {secret} and 7391", taken)
    assert "7391" in taken
