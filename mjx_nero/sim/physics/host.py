"""A Python function as an operation of compiled CPU programs, with a stable name.

JAX knows its own callbacks by an address, so it never caches a program with a callback between runs; compiling such programs
again took most of the start on a CPU. This operation uses XLA's foreign function interface through ctypes
(``xla/ffi/api/c_api.h``, part of jaxlib). Programs with it are cached like all others.
"""

import ctypes
import functools
from collections.abc import Callable

import jax
import numpy as np

# Writes its result, float32, into the second array.
Work = Callable[[np.ndarray, np.ndarray], None]

TARGET = "mjx_nero_host"
_VERSION = 0, 1  # of the interface; XLA takes this and newer ones
_METADATA = 1  # XLA_FFI_Extension_Metadata: asks for the version, and calls nothing
_INTERNAL = 13  # XLA_FFI_Error_Code_INTERNAL
_known: dict[int, Work] = {}


def offer(key: int, work: Work) -> None:
    """Lets programs call ``work``, those included that another process has traced or compiled.

    Args:
        key: identifies ``work``, in this process and in others. Functions with the same key have to do the same; the first one
            is called, and kept as long as the process lives.
        work: called while Python's lock is held. An exception becomes an error of the program.
    """
    _register()
    _known.setdefault(key, work)


def call(key: int, result: jax.ShapeDtypeStruct, given: jax.Array) -> jax.Array:
    """Calls what was offered with one float32 array and gives one back; under ``jit`` and ``vmap``, on a CPU.

    Args:
        key: see ``offer``.
        result: shape and type of the result, with the same leading axes as ``given``.
    """
    return jax.ffi.ffi_call(TARGET, result, vmap_method="broadcast_all")(given, key=np.int64(key))


class _Extension(ctypes.Structure):
    pass


class _Version(ctypes.Structure):
    _fields_ = (("size", ctypes.c_size_t), ("extension", ctypes.c_void_p), ("major", ctypes.c_int), ("minor", ctypes.c_int))


class _Metadata(ctypes.Structure):
    _fields_ = (("size", ctypes.c_size_t), ("version", _Version), ("traits", ctypes.c_uint32))


_Extension._fields_ = (
    ("size", ctypes.c_size_t),
    ("type", ctypes.c_int),
    ("next", ctypes.POINTER(_Extension)),
    ("metadata", ctypes.POINTER(_Metadata)),  # only in an extension of this type
)


class _Buffer(ctypes.Structure):
    _fields_ = (
        ("size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("dtype", ctypes.c_int),
        ("data", ctypes.c_void_p),
        ("rank", ctypes.c_int64),
        ("shape", ctypes.POINTER(ctypes.c_int64)),
    )

    def array(self) -> np.ndarray:
        """A view of the numbers, which are float32."""
        shape = tuple(self.shape[: self.rank])
        if not np.prod(shape):
            return np.empty(shape, np.float32)
        return np.ctypeslib.as_array(ctypes.cast(self.data, ctypes.POINTER(ctypes.c_float)), shape)


class _Scalar(ctypes.Structure):
    _fields_ = (("dtype", ctypes.c_int), ("value", ctypes.POINTER(ctypes.c_int64)))


def _list_of(kind: type[ctypes.Structure]) -> type[ctypes.Structure]:
    fields = (("size", ctypes.c_size_t), ("extension", ctypes.c_void_p), ("count", ctypes.c_int64), ("types", ctypes.c_void_p))
    names = (("names", ctypes.c_void_p),) if kind is _Scalar else ()  # attributes have names
    items = ("items", ctypes.POINTER(ctypes.POINTER(kind)))
    return type("_List", (ctypes.Structure,), {"_fields_": (*fields, *names, items)})


class _ErrorArgs(ctypes.Structure):
    _fields_ = (("size", ctypes.c_size_t), ("extension", ctypes.c_void_p), ("message", ctypes.c_char_p), ("code", ctypes.c_int))


class _Api(ctypes.Structure):
    _fields_ = (
        ("size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("version", _Version),
        ("internal", ctypes.c_void_p),
        ("error", ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_ErrorArgs))),
    )


class _Frame(ctypes.Structure):
    _fields_ = (
        ("size", ctypes.c_size_t),
        ("extension", ctypes.POINTER(_Extension)),
        ("api", ctypes.POINTER(_Api)),
        ("context", ctypes.c_void_p),
        ("stage", ctypes.c_int),
        ("args", _list_of(_Buffer)),
        ("results", _list_of(_Buffer)),
        ("attributes", _list_of(_Scalar)),
    )


@functools.cache
def _register() -> Callable:
    """Registers the operation with XLA, and keeps the function alive."""
    handler = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_Frame))(_handle)
    jax.ffi.register_ffi_target(TARGET, jax.ffi.pycapsule(handler), platform="cpu")
    return handler


def _handle(pointer) -> int | None:
    frame = pointer.contents
    try:
        if frame.extension and frame.extension.contents.type == _METADATA:
            version = frame.extension.contents.metadata.contents.version
            version.major, version.minor = _VERSION
            frame.extension.contents.metadata.contents.traits = 0
            return None
        key = frame.attributes.items[0].contents.value.contents.value
        _known[key](frame.args.items[0].contents.array(), frame.results.items[0].contents.array())
        return None
    except BaseException as error:  # no exception may pass through XLA's frames
        message = f"{type(error).__name__}: {error}".encode()
        return frame.api.contents.error(_ErrorArgs(ctypes.sizeof(_ErrorArgs), None, message, _INTERNAL))
