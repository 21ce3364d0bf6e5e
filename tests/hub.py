"""A Hub on this machine: the endpoints that `push` and `load` call, over real HTTP."""

import base64
import hashlib
import json
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from urllib.parse import unquote, urlsplit

import pytest
from huggingface_hub import constants


class Hub:
    """Repositories by name: their commits, each of which is files by name."""

    def __init__(self):
        self.repositories = {}
        self.locked = False
        self.asked = []

    def commit(self, repository, files):
        commits = self.repositories.setdefault(repository, {})
        text = f"{repository} {len(commits)}"
        name = hashlib.sha1(text.encode()).hexdigest()
        commits[name] = dict(files)
        return name

    def files(self, repository):
        """Of the newest commit."""
        return [*self.repositories[repository].values()][-1]

    def change(self, repository, name, content):
        """As who can write there may."""
        return self.commit(repository, {**self.files(repository), name: content})


class Answers(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    hub: Hub

    def log_message(self, format, *args):
        pass

    def do_HEAD(self):
        self.do_GET()

    def do_GET(self):
        parts = [unquote(part) for part in urlsplit(self.path).path.split("/")[1:]]
        self.hub.asked.append(parts)
        is_api = parts[0] == "api"
        owner, name, *asked = parts[2:] if is_api else parts
        commits = self.hub.repositories.get(f"{owner}/{name}")
        if commits is None:
            return self.answer({}, 404, {"X-Error-Code": "RepoNotFound"})
        kind, revision, *rest = asked or ["revision", "main"]
        if revision == "main":
            revision = [*commits][-1]
        if revision not in commits:
            return self.answer({}, 404, {"X-Error-Code": "RevisionNotFound"})
        files = commits[revision]
        if kind == "tree":
            return self.answer(
                [
                    {"type": "file", "path": path, "size": len(content), "oid": "0"}
                    for path, content in files.items()
                ]
            )
        if kind == "revision":
            return self.answer({"id": f"{owner}/{name}", "sha": revision})
        content = files["/".join(rest)]
        digest = hashlib.sha1(content).hexdigest()
        return self.answer(content, 200, {"ETag": digest, "X-Repo-Commit": revision})

    def do_POST(self):
        parts = [unquote(part) for part in urlsplit(self.path).path.split("/")[1:]]
        given = self.rfile.read(int(self.headers["Content-Length"]))
        if self.hub.locked:
            return self.answer({"error": "You may not write here."}, 403)
        if parts[-1] == "validate-yaml":
            return self.answer({"errors": [], "warnings": []})
        if parts[-1] == "create":
            entries = json.loads(given)
            name = f"{entries['organization']}/{entries['name']}"
            exists = name in self.hub.repositories
            if not exists:
                self.hub.commit(name, {".gitattributes": b""})
            return self.answer({"url": f"/{name}"}, 409 if exists else 200)
        repository = "/".join(parts[2:4])
        if parts[4] == "preupload":
            how = {"uploadMode": "regular", "shouldIgnore": False}
            return self.answer(
                {"files": [file | how for file in json.loads(given)["files"]]}
            )
        files = dict(self.hub.files(repository))
        for line in map(json.loads, given.splitlines()):
            value = line["value"]
            if line["key"] == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            elif line["key"] == "deletedFile":
                del files[value["path"]]
        made = self.hub.commit(repository, files)
        return self.answer({"commitOid": made, "commitUrl": f"/{repository}/{made}"})

    def answer(self, content, status=200, headers=None):
        if not isinstance(content, bytes):
            content = json.dumps(content).encode()
        self.send_response(status)
        for name, value in (headers or {}).items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)


@contextmanager
def served(folder):
    """A hub that huggingface_hub talks to, with its cache in a folder."""
    hub = Hub()
    handler = type("AnswersOf", (Answers,), {"hub": hub})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    thread = Thread(target=server.serve_forever, args=(0.01,), daemon=True)
    thread.start()
    endpoint = f"http://127.0.0.1:{server.server_port}"
    template = endpoint + "/{repo_id}/resolve/{revision}/{filename}"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NO_PROXY", "127.0.0.1")
        patch.delenv("HF_TOKEN", raising=False)
        patch.setattr(constants, "ENDPOINT", endpoint)
        patch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
        patch.setattr(constants, "HF_HUB_CACHE", str(folder / "cache"))
        patch.setattr(constants, "HF_TOKEN_PATH", str(folder / "token"))
        patch.setattr(constants, "HF_HUB_OFFLINE", False)
        yield hub
    server.shutdown()
    server.server_close()
