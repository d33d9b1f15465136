"""A hub on this machine: the few endpoints of the Hugging Face Hub that sharing a run calls."""

from __future__ import annotations

import base64
import hashlib
import importlib
import json
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest

LARGE = (".safetensors", ".gif", ".mp4", ".png")
"""What the real hub keeps as large files."""


@dataclass
class Commit:
    """All files of a repository at one time."""

    sha: str
    files: dict[str, bytes]


@dataclass
class Repo:
    """A repository: its commits, the latest last."""

    private: bool = False
    commits: list[Commit] = field(default_factory=list)

    def add(self, files: dict[str, bytes]) -> Commit:
        names = repr([(k, hashlib.sha1(v).hexdigest()) for k, v in files.items()])
        sha = hashlib.sha1(f"{len(self.commits)}{names}".encode()).hexdigest()
        self.commits.append(Commit(sha, files))
        return self.commits[-1]

    def at(self, revision: str) -> Commit | None:
        if revision == "main":
            return self.commits[-1]
        return next((c for c in self.commits if c.sha == revision), None)


@dataclass
class Hub:
    """What is on the hub, who may log in, and what was asked of it."""

    url: str = ""
    repos: dict[str, Repo] = field(default_factory=dict)
    users: dict[str, str] = field(default_factory=lambda: {"good-token": "ada"})
    large: dict[str, bytes] = field(default_factory=dict)
    asked: list[str] = field(default_factory=list)
    breaks_at: str = ""
    answer: int = 500
    """Requests whose path has ``breaks_at`` in it are answered with this."""

    def make(self, name: str, files: dict[str, bytes], private: bool = False) -> Repo:
        repo = self.repos[name] = Repo(private)
        repo.add({".gitattributes": b"*.safetensors filter=lfs\n", **files})
        return repo

    def files(self, name: str) -> dict[str, bytes]:
        """The latest files, without those of the hub's own."""
        latest = self.repos[name].commits[-1].files
        return {k: v for k, v in latest.items() if k != ".gitattributes"}


class Answer(Exception):
    """Ends a request with this answer."""

    def __init__(
        self, status: int, content: Any = None, headers: dict[str, str] | None = None
    ) -> None:
        self.status, self.headers = status, headers or {}
        self.content = content if isinstance(content, bytes) else json.dumps(content).encode()


class Handler(BaseHTTPRequestHandler):
    """Answers requests; the server's ``hub`` is what it knows."""

    server: Any
    protocol_version = "HTTP/1.1"

    def log_message(self, *_: Any) -> None:
        """Nothing is printed."""

    def answer(self) -> None:
        self.hub: Hub = self.server.hub
        body = self.body()
        path = unquote(urlsplit(self.path).path)
        self.hub.asked.append(f"{self.command} {path}")
        try:
            if self.hub.breaks_at and self.hub.breaks_at in path:
                raise Answer(self.hub.answer, {"error": "the disk of the hub is full"})
            for method, pattern, act in ROUTES:
                found = re.fullmatch(pattern, path)
                if found and self.command in method:
                    act(self, body, *found.groups())
            raise Answer(404, {"error": f"no such page: {path}"})
        except Answer as answer:
            self.send(answer)

    do_GET = do_HEAD = do_POST = do_PUT = answer

    def body(self) -> bytes:
        if self.headers.get("Transfer-Encoding", "") != "chunked":
            return self.rfile.read(int(self.headers.get("Content-Length", 0)))
        found = b""
        while size := int(self.rfile.readline(), 16):
            found += self.rfile.read(size)
            self.rfile.readline()
        self.rfile.readline()
        return found

    def send(self, answer: Answer) -> None:
        self.send_response(answer.status)
        for name, value in answer.headers.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(answer.content)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(answer.content)

    def user(self) -> str | None:
        token = self.headers.get("Authorization", "").removeprefix("Bearer ")
        return self.hub.users.get(token)

    def repo(self, name: str, writes: bool = False) -> Repo:
        """The repository, if this user may know of it."""
        owner, user, repo = name.partition("/")[0], self.user(), self.hub.repos.get(name)
        if repo is None or (repo.private and user != owner):
            # As the hub does it, who is not logged in learns nothing.
            headers = {"X-Error-Code": "RepoNotFound", "X-Error-Message": "Repository not found"}
            raise Answer(404 if user else 401, {"error": "Repository not found"}, headers)
        if writes and user != owner:
            headers = {"X-Error-Message": "you have no right to write"}
            raise Answer(403 if user else 401, {"error": "no"}, headers)
        return repo

    def commit_at(self, name: str, revision: str) -> Commit:
        found = self.repo(name).at(revision)
        if found is None:
            headers = {"X-Error-Code": "RevisionNotFound", "X-Error-Message": "Invalid rev id"}
            raise Answer(404, {"error": "Invalid rev id"}, headers)
        return found

    def create(self, body: bytes) -> None:
        told, user = json.loads(body), self.user()
        name = f"{told['organization']}/{told['name']}"
        if user is None:
            raise Answer(401, {"error": "Invalid username or password."})
        if name in self.hub.repos:
            raise Answer(409, {"error": "You already created this model repo", "url": name})
        if told["organization"] != user:
            raise Answer(403, {"error": "no"}, {"X-Error-Message": "no right to create a model"})
        private = told.get("visibility") == "private" or told.get("private") is True
        self.hub.make(name, {}, private)
        raise Answer(200, {"url": f"{self.hub.url}/{name}", "name": name})

    def yaml(self, body: bytes) -> None:
        assert json.loads(body)["content"].startswith("---\n")
        raise Answer(200, {"errors": [], "warnings": []})

    def info(self, body: bytes, name: str, revision: str | None) -> None:
        found = self.commit_at(name, revision or "main")
        siblings = [{"rfilename": path} for path in found.files]
        told = {"id": name, "sha": found.sha, "siblings": siblings}
        raise Answer(200, told | {"private": self.hub.repos[name].private})

    def tree(self, body: bytes, name: str, revision: str) -> None:
        files = self.commit_at(name, revision).files
        rows = [
            {"type": "file", "path": path, "size": len(data), "oid": hashlib.sha1(data).hexdigest()}
            for path, data in files.items()
        ]
        raise Answer(200, rows)

    def preupload(self, body: bytes, name: str) -> None:
        self.repo(name, writes=True)
        paths = [file["path"] for file in json.loads(body)["files"]]
        large = {p: PurePosixPath(p).suffix in LARGE for p in paths}
        told = [
            {"path": p, "uploadMode": "lfs" if large[p] else "regular", "shouldIgnore": False}
            for p in paths
        ]
        raise Answer(200, {"files": told})

    def batch(self, body: bytes, name: str) -> None:
        self.repo(name, writes=True)
        objects = [
            o | {"actions": {"upload": {"href": f"{self.hub.url}/large/{o['oid']}"}}}
            for o in json.loads(body)["objects"]
        ]
        raise Answer(200, {"transfer": "basic", "objects": objects})

    def put(self, body: bytes, oid: str) -> None:
        assert hashlib.sha256(body).hexdigest() == oid
        self.hub.large[oid] = body
        raise Answer(200, {})

    def commit(self, body: bytes, name: str) -> None:
        repo = self.repo(name, writes=True)
        files = dict(repo.commits[-1].files)
        for line in body.splitlines():
            told = json.loads(line)
            value = told["value"]
            if told["key"] == "header" and value["parentCommit"] != repo.commits[-1].sha:
                raise Answer(412, {"error": "the repository was changed meanwhile"})
            if told["key"] == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            if told["key"] == "lfsFile":
                files[value["path"]] = self.hub.large[value["oid"]]
            if told["key"] == "deletedFile":
                del files[value["path"]]
        sha = repo.add(files).sha
        raise Answer(200, {"commitUrl": f"{self.hub.url}/{name}/commit/{sha}", "commitOid": sha})

    def resolve(self, body: bytes, name: str, revision: str, path: str) -> None:
        found = self.commit_at(name, revision)
        headers = {"X-Repo-Commit": found.sha}
        if path not in found.files:
            raise Answer(404, {"error": "no"}, headers | {"X-Error-Code": "EntryNotFound"})
        data = found.files[path]
        headers["ETag"] = f'"{hashlib.sha1(data).hexdigest()}"'
        raise Answer(200, data, headers)


NAME = r"([\w.-]+/[\w.-]+)"
ROUTES = (
    ("POST", "/api/repos/create", Handler.create),
    ("POST", "/api/validate-yaml", Handler.yaml),
    ("GET", rf"/api/models/{NAME}(?:/revision/(\w+))?", Handler.info),
    ("GET", rf"/api/models/{NAME}/tree/(\w+)", Handler.tree),
    ("POST", rf"/api/models/{NAME}/preupload/main", Handler.preupload),
    ("POST", rf"/{NAME}\.git/info/lfs/objects/batch", Handler.batch),
    ("PUT", r"/large/(\w+)", Handler.put),
    ("POST", rf"/api/models/{NAME}/commit/main", Handler.commit),
    ("GET HEAD", rf"/{NAME}/resolve/(\w+)/(.+)", Handler.resolve),
)


@contextmanager
def serve() -> Iterator[Hub]:
    """A hub that answers while the block runs."""
    server: Any = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    server.hub = Hub(f"http://127.0.0.1:{server.server_address[1]}")
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield server.hub
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def go_to(url: str, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the hub's library talk to this address, logged in, with a cache of its own."""
    constants = importlib.import_module("huggingface_hub.constants")
    monkeypatch.setattr(constants, "ENDPOINT", url)
    template = url + "/{repo_id}/resolve/{revision}/{filename}"
    monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(cache))
    monkeypatch.setattr(constants, "HF_TOKEN_PATH", str(cache / "no-token"))
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)
    monkeypatch.setenv("HF_TOKEN", "good-token")
