"""The HTTP server: the page, its clips and files, and the socket."""

import asyncio
import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp as App
from starlette.websockets import WebSocket

from rsjax.tools.play.connection import Connection
from rsjax.tools.play.guard import Guard, Guarded
from rsjax.tools.play.hub import Hub
from rsjax.tools.play.keep import TYPES as FILE_TYPES
from rsjax.tools.play.messages import Refused
from rsjax.tools.play.pictures import webp

PAGE = Path(__file__).parent / "page"
PLAYER = Path(__file__).parents[1] / "studies" / "report" / "player"  # shared with the report, at page/player
TYPES = {
    ".html": "text/html",
    ".css": "text/css",
    ".js": "text/javascript",
    ".svg": "image/svg+xml",
    ".png": "image/png",
    ".webp": "image/webp",
    ".ico": "image/x-icon",
    ".json": "application/json",
    ".webmanifest": "application/manifest+json",
}
SWEEP = 5.0  # seconds between two searches for idle sessions
MOST_CLIPS = 100  # in one answer


def make_app(hub: Hub, guard: Guard, sweep: float = SWEEP) -> App:
    """Returns the server's application, which closes the hub when it ends; its caller closes the hub's engine."""

    async def sweep_hub() -> None:
        while True:
            await asyncio.sleep(sweep)
            hub.sweep()

    @asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        sweeper = asyncio.create_task(sweep_hub())
        yield
        sweeper.cancel()
        hub.close()

    routes = Routes(hub, guard)
    app = Starlette(
        routes=[
            Route("/", routes.index),
            Route("/page/{name:path}", routes.page),
            Route("/api/health", routes.health),
            Route("/api/clips", routes.clips),
            Route("/api/clip/{number}.webp", routes.clip),
            Route("/api/file/{number}", routes.file),
            WebSocketRoute("/ws", routes.socket),
        ],
        exception_handlers={404: _missing, 405: _missing},
        lifespan=lifespan,
    )
    return Guarded(app, guard)


async def _missing(request: Request, error: Exception) -> Response:
    return JSONResponse({"error": "missing", "message": "there is nothing at this address"}, 404)


class Routes:
    """The server's routes. No path comes from a request: names are looked up in a list that is made at the start."""

    def __init__(self, hub: Hub, guard: Guard) -> None:
        self._hub = hub
        self._guard = guard
        own = _files(PAGE)
        shared = _files(PLAYER)
        self._page = own | {f"player/{name}": path for name, path in shared.items()}

    async def index(self, request: Request) -> Response:
        return self._file("index.html")

    async def page(self, request: Request) -> Response:
        return self._file(request.path_params["name"])

    async def health(self, request: Request) -> Response:
        return self._known(request) or JSONResponse(
            {"ok": True, "sessions": len(self._hub), "most_sessions": self._hub.most, "frames": self._hub.engine.frames}
        )

    async def clips(self, request: Request) -> Response:
        if refused := self._known(request):
            return refused
        try:
            first, count = (int(request.query_params.get(name, value)) for name, value in _LISTED)
        except ValueError:
            first = -1
            count = 0
        if first < 0 or not 0 < count <= MOST_CLIPS:
            return _refused(400, "bad_message", f"first is 0 or more, count is from 1 to {MOST_CLIPS}")
        return JSONResponse(await asyncio.to_thread(self._list, first, count))

    async def clip(self, request: Request) -> Response:
        if refused := self._known(request):
            return refused
        number = request.path_params["number"]
        if not _NUMBER.fullmatch(number):
            return await _missing(request, ValueError(number))
        try:
            clip = await asyncio.to_thread(self._hub.run.clip, int(number))
        except Refused as error:
            return _refused(404, error.code, error.message)
        return Response(webp(clip["rgb"][0]), media_type="image/webp")

    async def file(self, request: Request) -> Response:
        path = self._hub.files[request.path_params["number"]]
        if refused := self._known(request):
            return refused
        if path is None or not path.is_file():
            return _refused(404, "missing", "this file is not there any more; make it again")
        return FileResponse(path, media_type=FILE_TYPES[path.suffix], filename=path.name)

    async def socket(self, socket: WebSocket) -> None:
        await socket.accept()
        headers = socket.headers
        if wrong := self._guard.wrong_host(headers) or self._guard.wrong_origin(headers):
            await socket.close(4403, wrong)
        elif not self._guard.knows(socket.query_params):
            await socket.close(4401, "the address lacks the token that the server printed")
        else:
            await Connection(socket, self._hub).serve(socket.query_params.get("session"))

    def _list(self, first: int, count: int) -> dict[str, Any]:
        run = self._hub.run
        clips = []
        for number in range(first, min(first + count, run.clips)):
            try:
                clip = run.clip(number)
            except Refused:
                continue
            labelled = run.store is not None and run.store.manifest.get("success_share") is not None
            if labelled:
                success = bool(clip["success"][-1])
            else:
                success = None
            facts = {"clip": number, "task": str(clip["task"]), "frames": len(clip["rgb"]), "success": success}
            clips.append(facts)
        return {"split": run.split, "total": run.clips, "clips": clips}

    def _file(self, name: str) -> Response:
        path = self._page.get(name)
        if path is None:
            return _refused(404, "missing", "there is nothing at this address")
        return FileResponse(path, media_type=TYPES[path.suffix])

    def _known(self, request: Request) -> Response | None:
        """Returns the response to a request without the token; None if the request has it."""
        if self._guard.knows(request.query_params):
            return None
        return _refused(401, "token", "the address lacks the token that the server printed")


def _files(folder: Path) -> dict[str, Path]:
    paths = (path for path in folder.rglob("*") if path.suffix in TYPES and path.is_file())
    return {path.relative_to(folder).as_posix(): path for path in paths}


_NUMBER = re.compile("[0-9]{1,10}")
_LISTED = (("first", 0), ("count", 48))


def _refused(status: int, code: str, message: str) -> Response:
    return JSONResponse({"error": code, "message": message}, status)
