"""The file of a site: what it refuses, and what it takes as it is."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from otolith.health.schema import LANGUAGES
from otolith.site.known import RefusedFor
from otolith.site.settings import load_site
from otolith.site.words import accepted, words_in
from otolith_drivers.errors import ConfigurationError
from tests.hostile import HOSTILE
from tests.messages import assert_refuses, assert_says


@pytest.mark.parametrize(
    ("text", "needles"),
    [
        ('[http]\nlisten = "0.0.0.0:8420"', ("http", "hosts")),
        ('[http]\nlisten = "site:8420"', ("http.listen", "127.0.0.1:8420")),
        ('[http]\nlisten = "127.0.0.1:0"', ("http.listen", "port")),
        ('[zenoh]\nconnect = ["plant"]', ("zenoh.connect", "tcp/")),
        ('titel = "x"', ("titel", "title")),
        ('timezone = "Europe/Atlantis"', ("timezone", "Atlantis")),
        ('machines = ["press-3"]', ("machines", "hall-1/press-3")),
        ('machines = ["hall/../x"]', ("machines", "not a valid name")),
        ('language = "fr"', ("language", "de")),
        ("title = 3", ("title",)),
        *((f'[outlets.webhook]\nurl = "{url}"', ("outlets.webhook.url", "https://example.org/hook"))
          for url in ("http://a:99999/", "http://a:b/", "http://a:0/", "http://[", "http://a/b c", "http://a/\u00fc",
                      "ftp://a/")),
        ('[outlets.mqtt]\nhost = "broker"\nuser = "a"\npassword_file = "b"', ("outlets.mqtt", "tls")),
    ],
)  # fmt: skip
def test_a_mistake_is_named_with_its_key_and_remedy(tmp_path: Path, text: str, needles: tuple[str, ...]) -> None:
    file = tmp_path / "site.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigurationError) as caught:
        load_site(file)
    assert_refuses(caught.value, file)
    assert_says(str(caught.value), *needles)


def test_an_empty_file_is_a_site_for_this_computer_only(tmp_path: Path) -> None:
    file = tmp_path / "site.toml"
    file.touch()
    settings, _ = load_site(file)
    assert settings.http.address == ("127.0.0.1", 8420)
    assert settings.connection(tmp_path).endpoints == ()


def test_files_are_relative_to_that_of_the_site(tmp_path: Path) -> None:
    file = tmp_path / "site.toml"
    file.write_text('[zenoh]\nca = "keys/ca.crt"\nlogin = "/etc/login"', encoding="utf-8")
    credentials = load_site(file)[0].connection(tmp_path).credentials
    assert credentials.ca == tmp_path / "keys" / "ca.crt"
    assert credentials.login == Path("/etc/login")


def test_each_word_is_in_each_language() -> None:
    assert len({frozenset(words_in(language)) for language in LANGUAGES}) == 1
    assert {f"refused_{reason}" for reason in RefusedFor} <= set(words_in("en"))


@pytest.mark.parametrize("header", ["", "fr", ",", ";q=1", *HOSTILE])
def test_an_unknown_language_is_english(header: str) -> None:
    assert accepted(header) == "en"


@pytest.mark.parametrize("text", ["titel = 1", '[outlets.webhook]\nurl = "https://a.example"\nsecret_file = "nowhere"'])
def test_a_wrong_file_ends_with_the_code_after_which_systemd_does_not_start_it_again(tmp_path: Path, text: str) -> None:
    file = tmp_path / "site.toml"
    file.write_text(text, encoding="utf-8")
    command = [sys.executable, "-m", "otolith", "site", str(file)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == os.EX_CONFIG
    assert_says(done.stderr, "site.toml")
