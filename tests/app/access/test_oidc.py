"""Tokens of an OpenID Connect issuer that runs here, with its own keys: what is believed, and how far it reaches."""

from __future__ import annotations

import base64
import hmac
import json
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from joserfc import jwt
from joserfc.jwk import ECKey, Key, KeySet, RSAKey

from app.access.oidc import ASK_AGAIN_S, open_issuer
from app.errors import UnavailableError
from app.settings import Settings

AUDIENCE = "magcal-here"


class Provider:
    """An issuer: it describes itself, publishes its keys and signs tokens."""

    def __init__(self) -> None:
        self.keys: list[Key] = [RSAKey.generate_key(2048, {"kid": "first", "use": "sig"}, private=True)]
        self.asked = 0
        provider = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                document = provider.documents().get(self.path)
                self.send_response(200 if document else 404)
                self.end_headers()
                self.wfile.write(json.dumps(document).encode())

            def log_message(self, *_arguments: object) -> None:
                """Say nothing."""

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}/realm"
        self.thread = threading.Thread(target=self.server.serve_forever)
        self.thread.start()

    def documents(self) -> dict[str, object]:
        self.asked += 1
        return {
            "/realm/.well-known/openid-configuration": {"issuer": self.url, "jwks_uri": f"{self.url}/keys"},
            "/realm/keys": KeySet(self.keys).as_dict(),
        }

    def token(self, *, key: Key | None = None, header: dict | None = None, **claims: object) -> str:
        """Return a token that is sound but for what is said; None leaves a claim out."""
        now = int(time.time())
        plain = {"iss": self.url, "aud": AUDIENCE, "sub": "ann", "exp": now + 300, "iat": now}
        plain |= {"magcal_scopes": "read operate", "magcal_satellites": ["mine"]}
        wanted = {name: value for name, value in (plain | claims).items() if value is not None}
        signing = self.keys[0] if key is None else key
        head = {"alg": "RS256", "kid": signing.kid} | (header or {})
        return jwt.encode(head, wanted, signing, algorithms=[head["alg"]])

    def stop(self) -> None:
        self.server.shutdown()
        self.thread.join()
        self.server.server_close()


@pytest.fixture(scope="module")
def provider() -> Iterator[Provider]:
    provider = Provider()
    yield provider
    provider.stop()


@pytest.fixture
def service(new_service, provider):
    service = new_service(oidc_issuer=provider.url, oidc_audience=AUDIENCE, auth_failures_per_minute=1_000_000)
    with service.client() as admin:
        for name in ("mine", "other"):
            admin.post("/satellites", json={"id": name}).raise_for_status()
    return service


def status(service, token: str, path: str = "/satellites") -> int:
    with service.client(token) as client:
        return client.get(path).status_code


def test_a_token_reaches_as_far_as_its_claims_and_is_named_in_the_trail(service, provider):
    with service.client(provider.token()) as client:
        assert [one["id"] for one in client.get("/satellites").json()["items"]] == ["mine"]
        assert client.get("/satellites/other").status_code == 404
        body = {"id": "m", "unit": "nT"}
        assert client.post("/satellites/mine/magnetometers", json=body).status_code == 201
        assert client.post("/keys", json={"scopes": ["read"]}).json()["code"] == "scope_required"
    with service.client() as admin:
        newest = admin.get("/audit").json()["items"][0]
        assert (newest["key_id"], newest["action"]) == ("oidc:ann", "magnetometer.create")
        assert admin.get("/satellites").status_code == 200  # magcal's own keys go on


@pytest.mark.parametrize(
    ("satellites", "reached"), [("*", {"mine", "other"}), (["*"], {"mine", "other"}), (None, set()), ([], set())]
)
def test_only_a_star_means_all_satellites(service, provider, satellites, reached):
    with service.client(provider.token(magcal_satellites=satellites)) as client:
        assert {one["id"] for one in client.get("/satellites").json()["items"]} == reached


def base64_of(content: bytes) -> str:
    return base64.urlsafe_b64encode(content).rstrip(b"=").decode()


def wrong_tokens(provider: Provider) -> dict[str, str]:
    now = int(time.time())
    stranger = RSAKey.generate_key(2048, {"kid": "first"}, private=True)
    public_pem = provider.keys[0].as_pem(private=False)
    sound = provider.token()
    head, body, signature = sound.split(".")
    unsigned = base64_of(b'{"alg":"none","kid":"first"}')
    hashed = base64_of(b'{"alg":"HS256","kid":"first"}') + "." + body
    signed_with_public = hmac.digest(public_pem, hashed.encode(), "sha256")
    return {
        "another issuer": provider.token(iss="http://127.0.0.1:1/realm"),
        "no issuer": provider.token(iss=None),
        "another audience": provider.token(aud="another"),
        "no audience": provider.token(aud=None),
        "expired": provider.token(exp=now - 60),
        "no end": provider.token(exp=None),
        "valid for a year": provider.token(exp=now + 86_400 * 365),
        "an end that is no number": provider.token(exp="tomorrow"),
        "not yet": provider.token(nbf=now + 600),
        "made in the future": provider.token(iat=now + 600),
        "no subject": provider.token(sub=None),
        "no scopes": provider.token(magcal_scopes=None),
        "unknown scopes": provider.token(magcal_scopes="root superuser"),
        "satellites that are no names": provider.token(magcal_satellites=["../etc"]),
        "signed by another key": provider.token(key=stranger),
        "an unknown key": provider.token(header={"kid": "unknown"}),
        "the public key as a secret": f"{hashed}.{base64_of(signed_with_public)}",
        "no signature": f"{unsigned}.{body}.",
        "a signature of another algorithm": f"{unsigned}.{body}.{signature}",
        "a changed body": f"{head}.{base64_of(b'{}')}.{signature}",
        "a key of its own": provider.token(key=stranger, header={"jwk": stranger.as_dict(private=False)}),
        "no token": "a.b.c",
        "too long": provider.token(more="x" * 10_000),
    }


def test_every_wrong_token_gets_the_one_refusal_of_every_wrong_key(service, provider):
    with service.client("mgc_nobody") as client:
        expected = client.get("/satellites").content
    for kind, token in wrong_tokens(provider).items():
        with service.client(token) as client:
            answer = client.get("/satellites")
        assert (answer.status_code, answer.content) == (401, expected), kind


def test_guessed_tokens_are_counted_like_guessed_keys(new_service, provider):
    service = new_service(oidc_issuer=provider.url, oidc_audience=AUDIENCE, auth_failures_per_minute=3)
    assert [status(service, provider.token(aud="x")) for _ in range(5)] == [401] * 3 + [429] * 2
    assert status(service, provider.token()) == 200


def test_new_keys_of_the_issuer_are_found_and_invented_ones_do_not_make_it_work(service, provider, monkeypatch):
    assert status(service, provider.token()) == 200
    asked = provider.asked
    for number in range(5):
        assert status(service, provider.token(header={"kid": f"invented-{number}"})) == 401
    assert provider.asked == asked
    newer = ECKey.generate_key("P-256", {"kid": "second", "use": "sig"}, private=True)
    provider.keys.append(newer)
    try:
        monkeypatch.setattr("app.access.oidc.ASK_AGAIN_S", 0.0)
        assert status(service, provider.token(key=newer, header={"alg": "ES256"})) == 200
        assert status(service, provider.token()) == 200
    finally:
        provider.keys.remove(newer)
    assert ASK_AGAIN_S >= 10


def test_an_issuer_that_does_not_answer_is_a_503_for_tokens_and_nothing_for_keys(new_service, provider):
    service = new_service(oidc_issuer="http://127.0.0.1:9/realm", oidc_audience=AUDIENCE)
    with service.client(provider.token()) as client:
        answer = client.get("/satellites")
    assert (answer.status_code, answer.json()["code"], bool(answer.headers["retry-after"])) == (
        503,
        "unavailable",
        True,
    )
    assert status(service, service.admin_key) == 200


def test_settings_that_would_believe_too_much_are_refused(tmp_path):
    for issuer, audience in (("http://id.example.org", "magcal"), ("https://id.example.org", None)):
        with pytest.raises(UnavailableError):
            open_issuer(Settings(data_dir=tmp_path, oidc_issuer=issuer, oidc_audience=audience))
    assert open_issuer(Settings(data_dir=tmp_path)) is None
