"""The dashboard's pages, filled in the browser from the public API, whose first answers they bring along; the login."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Annotated, Final
from urllib.parse import parse_qsl

from fastapi import APIRouter, Depends, Request, Response
from fastapi.responses import HTMLResponse, JSONResponse, RedirectResponse

from app.access.authentication import LOGIN_COOKIE, AccessServices, authenticate, is_same_origin, verify_key
from app.access.caller import Caller
from app.access.key_repository import KEY_FORM, KeyRepository
from app.attention.endpoints import AttentionServices
from app.dashboard import assets, page_data
from app.dashboard.choices import choices_json
from app.errors import TooManyFailuresError, UnauthorizedError
from app.http.dependencies import Config, Db
from app.http.services import services_of
from app.http.strict_json import in_time
from app.parameter_sets.json_listing import ListingServices
from app.parameter_sets.reasons import REASONS
from app.reporting.figures.page import script_json

if TYPE_CHECKING:
    from jinja2 import Environment

router = APIRouter(include_in_schema=False)

PAGE_HEADERS: Final = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
        "connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "same-origin",
    "Cache-Control": "no-store",
}
"""Nothing is loaded from elsewhere and no script stands inside a page; the plot library sets style attributes."""
MOST_FORM_BYTES: Final = 4096
WRONG_KEY: Final = "This is not a valid key. It may have expired or been revoked."


@dataclass(frozen=True, kw_only=True)
class PageServices(AccessServices, AttentionServices, ListingServices):
    """What the pages need of what the application holds; ``preparing`` is as in `OperationServices`."""

    preparing: Callable[[], tuple[int, int] | None]


@cache
def templates() -> Environment:
    """Return the environment of the pages' templates."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(loader=PackageLoader("app.dashboard"), autoescape=True, undefined=StrictUndefined)


def _render(name: str, status: int = 200, **values: object) -> HTMLResponse:
    known = {"plotly_version": assets.plotly_version(), "static": f"/static/{assets.static_version()}"}
    page = templates().get_template(name).render(known, **values)
    return HTMLResponse(page, status, headers=PAGE_HEADERS)


def _caller(request: Request) -> Caller | None:
    try:
        return authenticate(request)
    except UnauthorizedError:
        return None


def _page(
    request: Request,
    template: str,
    title: str,
    ask: page_data.Bringer | None = None,
    *,
    status: int = 200,
    values: Mapping[str, object] | None = None,
) -> HTMLResponse:
    caller = _caller(request)
    if caller is None:
        address = request.url.path + (f"?{request.url.query}" if request.url.query else "")
        return _render("login.html", title="Sign in", target=address, message="")
    name = template.replace(".html", ".js")
    script = name if name in assets.names() else "plain.js"
    held = services_of(request.app, PageServices)
    # Asked for before the answers are: what happens meanwhile is told by the stream, and not lost between the two.
    newest_event = page_data.newest_event(held.database)
    answers = page_data.brought(ask, caller, held.database, held.texts)
    return _render(
        template,
        status,
        **(values or {}),
        title=title,
        script=script,
        modules=assets.modules(script),
        scopes=sorted(caller.scopes),
        answers={path: script_json(text) for path, text in answers.items()},
        newest_event=newest_event,
        preparing=held.preparing(),
        counts=page_data.counts_of(held.fleet, caller, held.database),
    )


def _choices() -> Mapping[str, object]:
    return {"choices": choices_json()}


@router.get("/")
def overview_page(request: Request) -> HTMLResponse:
    """Show every satellite with its state at a glance."""
    fleet = services_of(request.app, PageServices).fleet
    return _page(request, "overview.html", "Needs attention", page_data.of_overview(fleet))


@router.get("/satellites/{satellite_id}")
def satellite_page(satellite_id: str, request: Request) -> HTMLResponse:
    """Show a satellite: its history, sessions, parameter sets and orbits."""
    return _page(request, "satellite.html", satellite_id, page_data.of_satellite(satellite_id), values=_choices())


@router.get("/satellites/{satellite_id}/magnetometers")
def magnetometers_page(satellite_id: str, request: Request) -> HTMLResponse:
    """Show the magnetometers of a satellite beside each other."""
    title = f"Magnetometers of {satellite_id}"
    return _page(request, "magnetometers.html", title, page_data.of_satellite(satellite_id), values=_choices())


@router.get("/satellites/{satellite_id}/magnetometers/{magnetometer_id}")
def magnetometer_page(satellite_id: str, magnetometer_id: str, request: Request) -> HTMLResponse:
    """Show a magnetometer: how its telemetry is read, and what becomes of it by itself."""
    bring = page_data.of_magnetometer(satellite_id, magnetometer_id)
    return _page(request, "magnetometer.html", f"{satellite_id} {magnetometer_id}", bring, values=_choices())


@router.get("/sessions/{session_id}")
def session_page(session_id: str, request: Request) -> HTMLResponse:
    """Show a session."""
    return _page(request, "session.html", f"Session {session_id}", page_data.of_session(session_id), values=_choices())


@router.get("/parameter-sets/{set_id}")
def parameter_set_page(set_id: str, request: Request) -> HTMLResponse:
    """Show a parameter set, its verdict first."""
    return _page(request, "parameter_set.html", f"Parameter set {set_id}", page_data.of_parameter_sets(set_id))


@router.get("/compare")
def compare_page(request: Request) -> HTMLResponse:
    """Show two parameter sets side by side."""
    asked = [one for name in ("first", "second") if (one := request.query_params.get(name))]
    return _page(request, "compare.html", "Compare parameter sets", page_data.of_parameter_sets(*dict.fromkeys(asked)))


@router.get("/jobs")
def jobs_page(request: Request) -> HTMLResponse:
    """Show the jobs, live."""
    return _page(request, "jobs.html", "Jobs", page_data.of_jobs)


@router.get("/reprocessings")
def reprocessings_page(request: Request) -> HTMLResponse:
    """Show the reprocessings, and start one."""
    return _page(request, "reprocessings.html", "Reprocessing", page_data.of_reprocessings, values=_choices())


@router.get("/reprocessings/{job_id}")
def reprocessing_page(job_id: str, request: Request) -> HTMLResponse:
    """Show one reprocessing: how far it is, and what its sets say beside those in force."""
    return _page(request, "reprocessing.html", f"Reprocessing {job_id}", page_data.of_job(job_id), values=_choices())


@router.get("/reasons")
def reasons_page(request: Request) -> HTMLResponse:
    """Show every reason that a verdict may have, in plain words."""
    return _page(request, "reasons.html", "Reasons of a verdict", values={"reasons": REASONS})


def unknown_page(request: Request) -> HTMLResponse:
    """Return the page for an address at which there is nothing."""
    return _page(request, "unknown.html", "Not found", status=404)


@router.get("/keys")
def keys_page(request: Request) -> HTMLResponse:
    """Show the keys and the audit trail."""
    return _page(request, "keys.html", "Keys", page_data.of_keys)


async def form_fields(request: Request) -> dict[str, str]:
    """Return the fields of a short form; what is longer than any login is no form of ours."""
    body = b""
    async for piece in in_time(request.stream(), services_of(request.app, PageServices).settings.request_timeout_s):
        body += piece
        if len(body) > MOST_FORM_BYTES:
            return {}
    return dict(parse_qsl(body.decode("utf-8", "replace"), max_num_fields=8))


@router.post("/login")
def log_in(
    request: Request, db: Db, config: Config, fields: Annotated[dict[str, str], Depends(form_fields)]
) -> Response:
    """Exchange a key for a cookie that scripts cannot read and other sites cannot use."""
    key, target = fields.get("key", "").strip(), _own_path(fields.get("target", "/"))
    if not is_same_origin(request):
        return _render("login.html", 403, title="Sign in", target="/", message="Sign in from this site's own page.")
    held = services_of(request.app, PageServices)
    limiter = held.failures
    form = KEY_FORM.fullmatch(key)
    address = request.client.host if request.client else "unknown"
    suspects = [f"address {address}", *([f"key {form[1]}"] if form else [])]
    with db.write() as session:
        holder = verify_key(session, key, held.clock.now())
        token = None
        if holder is not None:
            caller = Caller(holder.key_id, holder.scopes, address=address, request_id=request.state.request_id)
            token = KeyRepository(session, caller).open_login(holder.key_id, config.login_hours)
    if token is None:
        try:
            limiter.check(*suspects)
        except TooManyFailuresError as error:
            refused = _render("login.html", 429, title="Sign in", target=target, message=f"{error.message}.")
            refused.headers.update(error.headers)
            return refused
        limiter.note(*suspects)
        return _render("login.html", 403, title="Sign in", target=target, message=WRONG_KEY)
    response = RedirectResponse(target, 303, headers={"Cache-Control": "no-store"})
    response.set_cookie(
        LOGIN_COOKIE,
        token,
        max_age=int(config.login_hours * 3600),
        httponly=True,
        samesite="strict",
        secure=request.url.scheme == "https",
    )
    return response


@router.get("/login/state")
def login_state(request: Request) -> JSONResponse:
    """Tell whether the request's cookie is a login in force."""
    return JSONResponse({"signed_in": _caller(request) is not None}, headers={"Cache-Control": "no-store"})


@router.post("/logout")
def log_out(request: Request, db: Db) -> Response:
    """Forget the login."""
    token = request.cookies.get(LOGIN_COOKIE)
    if token is not None and is_same_origin(request):
        with db.write() as session:
            KeyRepository(session).close_login(token)
    response = RedirectResponse("/", 303, headers={"Cache-Control": "no-store"})
    response.delete_cookie(LOGIN_COOKIE, httponly=True, samesite="strict")
    return response


def _own_path(target: str) -> str:
    """Return ``target`` where it is a path of this service, else the first page: no open redirect."""
    is_own = target.startswith("/") and not target.startswith(("//", "/\\")) and target.isprintable()
    return target if is_own else "/"


router.routes.extend(assets.router.routes)
