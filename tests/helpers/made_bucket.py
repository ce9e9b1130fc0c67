# SPDX-License-Identifier: Apache-2.0
"""An S3 server of our own, and places in a folder and in a bucket of it."""

import logging
import urllib.request
from functools import cache
from uuid import uuid4

import pytest


@pytest.fixture(scope="session")
def s3():
    """Return the name of a bucket (`s3://...`) on a server in this process; the usual variables name it."""
    pytest.importorskip("obstore")
    moto = pytest.importorskip("moto.server")
    dispatcher = moto.DomainDispatcherApplication
    logging.getLogger("werkzeug").setLevel(logging.ERROR)  # a line for each request
    server = moto.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    url = f"http://{host}:{port}"
    with pytest.MonkeyPatch.context() as patch:
        # It lists all its modules for each request.
        patch.setattr(dispatcher, "get_backend_for_host", cache(dispatcher.get_backend_for_host))
        for name, value in {
            "AWS_ENDPOINT_URL": url, "AWS_ALLOW_HTTP": "true", "AWS_REGION": "us-east-1",
            "AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test", "NO_PROXY": "*",
        }.items():  # fmt: skip
            patch.setenv(name, value)
        urllib.request.urlopen(urllib.request.Request(f"{url}/bucket", method="PUT"))
        yield "s3://bucket"
    server.stop()


@pytest.fixture(params=["folder", "s3"])
def where(request, tmp_path):
    """Return the name of a place if nothing is yet: in a folder, then in a bucket."""
    if request.param == "folder":
        return str(tmp_path / "city.svox")
    return f"{request.getfixturevalue('s3')}/{uuid4().hex}/city.svox"
