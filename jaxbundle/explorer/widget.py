"""A view as a notebook widget: the page of the explorer, without a server.

    show(NetworkView(result))

The page is in a frame; requests of its controls and the answers pass through the notebook to and
from the view in this process. It works wherever anywidget does: Jupyter, VS Code, Colab, marimo.
"""

import functools
from importlib.resources import files
from typing import Any

from jaxbundle.arguments import integer
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.explorer.server import Refused, page_file, respond
from jaxbundle.explorer.view import ExplorerView


def show(view: ExplorerView, *, height: int = 800) -> Any:
    """A widget that shows a view (`NetworkView`, `CameraView`, `FlightView`) and answers its
    controls; `height` of the frame in pixels.

    **Raises:** `ImportError` without anywidget (extra `widgets`)."""
    # Lower than its controls, or higher than any screen, a frame is of no use.
    height = integer("height", height, 200, 4000)
    page = page_file(view, {}, live=True).content.decode()
    widget = _widget_class()(page=page, height=height)
    widget.on_msg(lambda sender, content, _: sender.send(*reply(view, content)))
    return widget


def reply(view: ExplorerView, message: Any) -> tuple[dict[str, Any], list[bytes]]:
    """The answer to a message of the page (`number`, `action`, `given`), and its content."""
    number = message.get("number") if isinstance(message, dict) else None
    try:
        given = message["given"]
        if not isinstance(given, dict):
            raise InputError("expected values by name")
        file = respond(view, str(message["action"]), given)
    except (InputError, NotSolvedError, Refused) as error:
        return {"number": number, "error": str(error)}, []
    except Exception as error:  # A program fault: shown on the page, the notebook continues.
        return {"number": number, "error": f"{type(error).__name__}: {error}"}, []
    return {"number": number, "type": file.type}, [file.content]


@functools.cache
def _widget_class() -> Any:
    try:
        import anywidget
        import traitlets
    except ImportError as error:
        raise ImportError("widgets need anywidget: pip install 'jaxbundle[widgets]'") from error
    script = files("jaxbundle.explorer.page").joinpath("widget.js").read_text(encoding="utf-8")
    traits = {"page": traitlets.Unicode().tag(sync=True), "height": traitlets.Int().tag(sync=True)}
    # Made here, not at the top: its base class may not be installed.
    return type("Explorer", (anywidget.AnyWidget,), {"_esm": script, **traits})
