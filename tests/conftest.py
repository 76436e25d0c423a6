"""What all tests need."""

import signal

import pytest

from torch_panda.bullet import native


@pytest.fixture(scope="session", autouse=True)
def interrupts():
    """Ctrl-C raises, also where a shell's background job started with it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(params=["native", "ctypes"])
def loop(request, monkeypatch):
    """Steps through either loop: whatever a test finds must hold for both."""
    if request.param == "native" and native.LIBRARY is None:
        pytest.skip("installed where there was no C compiler")
    monkeypatch.setenv(native.LOOP_VARIABLE, request.param)
    return request.param
