"""The messages that a page may send to its server: four kinds, with bounds, about existing controls and objects."""

from typing import Annotated, Literal

import msgspec
import viser

LONGEST = 4096  # maximum bytes of a message; the page's own have about 500
SLACK = 1e-6  # tolerance as a share of a slider's range: the browser rounds to steps

_Word = Annotated[str, msgspec.Meta(max_length=256)]
_Number = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]  # neither infinite nor NaN
_Near = Annotated[float, msgspec.Meta(ge=-100.0, le=100.0)]  # [m]
_Vector = tuple[_Number, _Number, _Number]
_Point = tuple[_Near, _Near, _Near]
_Pixel = tuple[_Number, _Number]


class _Said(msgspec.Struct, tag_field="type", tag=True, forbid_unknown_fields=True):
    """A message, named as viser names it."""


class ViewerCameraMessage(_Said):
    """The pose of the page's camera."""

    wxyz: tuple[_Number, _Number, _Number, _Number]
    position: _Vector
    fov: _Number
    near: _Number
    far: _Number
    image_height: _Number
    image_width: _Number
    look_at: _Vector
    up_direction: _Vector


class _Update(msgspec.Struct, forbid_unknown_fields=True):
    """A control's new value. viser itself would set any attribute of the control's handle."""

    value: bool | int | float | _Word


class GuiUpdateMessage(_Said):
    """A control was used."""

    uuid: _Word
    updates: _Update


class SceneNodeDragMessage(_Said):
    """An object is dragged."""

    phase: Literal["start", "update", "end"]
    name: _Word
    instance_index: int | None
    start_position: _Point
    start_screen_pos: _Pixel
    end_position: _Point
    end_screen_pos: _Pixel
    button: Literal["left", "middle", "right"]
    modifier: _Word | None
    owner: Literal[""]


class CommandTriggerMessage(_Said):
    """A command's key was pressed."""

    uuid: _Word


_DECODER = msgspec.msgpack.Decoder(ViewerCameraMessage | GuiUpdateMessage | SceneNodeDragMessage | CommandTriggerMessage)


def checked(raw: bytes, server: viser.ViserServer) -> bytes:
    """Checks a message and encodes it again, so that viser reads only what was checked.

    Raises:
        ValueError: it is not a message of a page, or it names something that does not exist.
    """
    try:
        said = _DECODER.decode(raw)
    except (msgspec.MsgspecError, RecursionError) as error:
        raise ValueError(str(error)) from None
    if isinstance(said, GuiUpdateMessage) and not _is_choice(server, said.uuid, said.updates.value):
        raise ValueError("not a value of an existing control")
    if isinstance(said, SceneNodeDragMessage) and not _is_there(server, said.name, said.instance_index):
        raise ValueError("not an object that can be dragged")
    if isinstance(said, CommandTriggerMessage) and said.uuid not in server.gui._command_handle_from_uuid:
        raise ValueError("not an existing command")
    return msgspec.msgpack.encode(said)


def _is_choice(server: viser.ViserServer, uuid: str, value: bool | int | float | str) -> bool:
    control = server.gui._gui_input_handle_from_uuid.get(uuid)
    if isinstance(control, viser.GuiDropdownHandle):
        return value in control.options
    if isinstance(control, viser.GuiSliderHandle):
        slack = SLACK * (control.max - control.min)
        number = isinstance(value, int | float) and not isinstance(value, bool)
        return number and control.min - slack <= value <= control.max + slack  # type: ignore[operator]
    return isinstance(control, viser.GuiButtonHandle) and value is True


def _is_there(server: viser.ViserServer, name: str, index: int | None) -> bool:
    thing = server.scene._handle_from_node_name.get(name)
    return isinstance(thing, viser.BatchedMeshHandle) and 0 <= (index or 0) < len(thing.batched_positions)
