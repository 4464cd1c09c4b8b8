"""Trees of plain data as one zip: JSON beside ``.npy`` members, nothing that could run code on loading.

A tree is made of None, bool, int, float, str, list, tuple, dict, NumPy arrays and torch tensors. Classes come from a
fixed list and are stored by name. Of anything else among an agent's arguments only the name is stored, and loading asks
for it again; elsewhere it is refused, so that what cannot be read is never written.
"""

import io
import json
import math
import os
import pathlib
import zipfile
from collections import OrderedDict
from collections.abc import Collection, Iterable
from typing import Any, BinaryIO

import numpy as np
import torch as th
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common import noise

from sb3_skillgraph.files import replaced
from sb3_skillgraph.version import __version__

SCHEMA = 2
#: Bytes that a file may have to be read. For larger ones, of whom you trust, raise it: ``sb3_skillgraph.saving.MAX_BYTES``.
MAX_BYTES = 16 * 2**30
PathOrFile = str | pathlib.Path | io.BufferedIOBase | BinaryIO

_NOISES = (noise.NormalActionNoise, noise.OrnsteinUhlenbeckActionNoise, noise.VectorizedActionNoise)
_CLASSES: dict[str, type] = {
    cls.__name__: cls
    for cls in (
        *(DDPG, TD3, SAC, *_NOISES),
        *(th.nn.ReLU, th.nn.LeakyReLU, th.nn.ELU, th.nn.GELU, th.nn.SiLU, th.nn.Tanh, th.nn.Sigmoid, th.nn.Softplus),
        *(np.float32, np.float64),
        *(th.optim.Adam, th.optim.AdamW, th.optim.SGD, th.optim.RMSprop),
    )
}


def known_classes(*classes: type) -> None:
    """Let classes of this library be stored by name."""
    _CLASSES.update((cls.__name__, cls) for cls in classes)


class MissingCallable:
    """Stands in a loaded tree for something that is stored by name only and must be given again.

    :param name: its name
    """

    def __init__(self, name: str) -> None:
        self.name = name


class _Encoder:
    """Turns a tree into JSON and one array per dtype, into which all arrays of that dtype are strung.

    :param by_name: entries of the tree in which what has no encoding is stored by its name
    """

    def __init__(self, by_name: Collection[str] = ()) -> None:
        self.by_name = by_name
        self.parts: dict[str, list[np.ndarray]] = {}
        self.sizes: dict[str, int] = {}

    def encode(self, tree: Any, *where: str) -> Any:
        """Return a tree, or the part of one that stands at some place, as JSON.

        :raises ValueError: naming the place of what could not be read again
        """
        kind = type(tree)
        if tree is None or kind in (bool, int, float, str):
            return tree
        if isinstance(tree, np.generic) and not tree.dtype.hasobject and tree.dtype.names is None:
            return self.encode(tree.item(), *where)
        if isinstance(tree, th.Tensor):
            return {"__tensor__": self._array(tree.detach().cpu().numpy(), where)}
        if kind in (np.ndarray, np.memmap):
            return {"__array__": self._array(tree, where)}
        if kind is tuple:
            return {"__tuple__": self._items(tree, where)}
        if kind is list:
            return self._items(tree, where)
        if kind in (dict, OrderedDict):
            if all(type(key) is str and not key.startswith("__") for key in tree):
                return {key: self.encode(value, *where, key) for key, value in tree.items()}
            return {"__pairs__": [[self.encode(k, *where, "a key"), self.encode(v, *where, str(k))] for k, v in tree.items()]}
        if kind in _NOISES:
            return {"__object__": [kind.__name__, self.encode(vars(tree), *where)]}
        if isinstance(tree, type) and _CLASSES.get(tree.__name__) is tree:
            return {"__class__": tree.__name__}
        if where and where[0] in self.by_name:
            return {"__callable__": getattr(tree, "__qualname__", kind.__qualname__)}
        raise ValueError(f"{'/'.join(where)} cannot be saved: a {kind.__qualname__} has no encoding.")

    def _items(self, items: Iterable[Any], where: tuple[str, ...]) -> list[Any]:
        return [self.encode(item, *where, str(i)) for i, item in enumerate(items)]

    def _array(self, array: np.ndarray, where: tuple[str, ...]) -> list[Any]:
        if array.dtype.kind not in "biufcSU":
            raise ValueError(f"{'/'.join(where)} cannot be saved: an array of {array.dtype} has no encoding.")
        dtype = array.dtype.str
        start = self.sizes.get(dtype, 0)
        self.parts.setdefault(dtype, []).append(np.ascontiguousarray(array).ravel())
        self.sizes[dtype] = start + array.size
        return [dtype, start, list(array.shape)]


def check_encoding(tree: Any, name: str) -> None:
    """Refuse what could not be read again.

    :param tree: what is to be saved
    :param name: of it
    :raises ValueError: naming the place
    """
    _Encoder().encode(tree, name)


def _decode(tree: Any, arrays: dict[str, np.ndarray], left: dict[str, int]) -> Any:
    """Return the tree that was encoded.

    :param arrays: by their dtypes
    :param left: how much of each has not been read: every array is its own part
    """
    if isinstance(tree, list):
        return [_decode(item, arrays, left) for item in tree]
    if not isinstance(tree, dict):
        return tree
    if len(tree) == 1:
        ((key, value),) = tree.items()
        if key in ("__array__", "__tensor__"):
            dtype, start, shape = value
            size = math.prod(shape)
            left[dtype] -= size
            if left[dtype] < 0 or not 0 <= start <= len(arrays[dtype]) - size:
                raise ValueError("it speaks of more numbers than it holds")
            array = arrays[dtype][start : start + size].reshape(shape).copy()
            return th.from_numpy(array) if key == "__tensor__" else array
        if key == "__tuple__":
            return tuple(_decode(item, arrays, left) for item in value)
        if key == "__pairs__":
            return {_decode(k, arrays, left): _decode(v, arrays, left) for k, v in value}
        if key == "__class__":
            return _CLASSES[value]
        if key == "__callable__":
            return MissingCallable(value)
        if key == "__object__":
            name, attributes = value
            if _CLASSES.get(name) not in _NOISES:
                raise ValueError(f"it names an object of unknown class {name!r}")
            restored: Any = object.__new__(_CLASSES[name])
            vars(restored).update(_decode(attributes, arrays, left))
            return restored
    return {key: _decode(value, arrays, left) for key, value in tree.items()}


def save_tree(path: PathOrFile, kind: str, tree: dict[str, Any], by_name: Collection[str] = ()) -> None:
    """Write a tree; a file is written beside its place and then renamed, so that the old one stays until the new is whole.

    :param path: path (``.zip`` is added if it has none) or binary file object
    :param kind: what the file holds, checked on loading
    :param tree: the data
    :param by_name: entries of the tree in which what is no plain data is stored by its name
    :raises ValueError: naming what is no plain data elsewhere: it could not be read again
    :raises OSError: if the file cannot be written; an old file of that name is then untouched
    """
    encoder = _Encoder(by_name)
    document = {"schema": SCHEMA, "kind": kind, "version": __version__, "tree": encoder.encode(tree)}
    if not isinstance(path, str | pathlib.Path):
        _write(path, document, encoder)
        return
    path = pathlib.Path(path)
    path = path.with_name(path.name + ".zip") if path.suffix == "" else path
    with replaced(path) as file:
        _write(file, document, encoder)


def _write(file: Any, document: dict[str, Any], encoder: _Encoder) -> None:
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr("agent.json", json.dumps(document))
        for dtype, parts in encoder.parts.items():
            name = dtype[1:] if dtype[0] != ">" else f"big_endian_{dtype[1:]}"
            with archive.open(f"arrays/{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.concatenate(parts, dtype=dtype), allow_pickle=False)


def load_tree(path: PathOrFile, kind: str) -> dict[str, Any]:
    """Read a tree; nothing in the file is ever executed.

    :param path: path (with or without ``.zip``) or binary file object
    :param kind: what the file must hold
    :return: the data
    :raises FileNotFoundError: if there is no such file
    :raises ValueError: if the file is damaged, of another kind, or of another schema
    """
    if isinstance(path, str | pathlib.Path):
        given = pathlib.Path(path)
        path = given if given.exists() else given.with_name(given.name + ".zip")
        if not path.is_file():
            raise FileNotFoundError(f"There is no file {str(given)!r}, nor {str(path)!r}.")
    try:
        with zipfile.ZipFile(path) as archive:
            return _read(archive, kind)
    except FileNotFoundError:
        raise
    except Exception as error:  # whatever a damaged file makes zipfile, json or NumPy raise
        name = str(path) if isinstance(path, pathlib.Path) else "the given file"
        raise ValueError(
            f"Cannot load {name}: {error}. It must be a whole file written by sb3_skillgraph (kind {kind!r}); files of "
            "other programs, and damaged ones, are not read, and nothing in them is executed."
        ) from error


def _read(archive: zipfile.ZipFile, kind: str) -> dict[str, Any]:
    if "agent.json" not in archive.namelist():
        raise ValueError("it holds no agent.json")
    _check_sizes(archive)
    document = json.loads(archive.read("agent.json"))
    written = f"it was written by sb3_skillgraph {document.get('version')} in schema {document['schema']}"
    if document["schema"] > SCHEMA:
        raise ValueError(f"{written}, newer than the schema {SCHEMA} that sb3_skillgraph {__version__} reads: upgrade it")
    if document["schema"] < SCHEMA:
        raise ValueError(
            f"{written}; this one ({__version__}) reads schema {SCHEMA} only: load it with that one, or train anew"
        )
    if document["kind"] != kind:
        raise ValueError(f"it holds a {document['kind']!r}, not a {kind!r}")
    arrays = {}
    for name in archive.namelist():
        if name.endswith(".npy"):
            with archive.open(name) as member:
                array = _read_array(io.BytesIO(member.read()))
            arrays[array.dtype.str] = array
    left = {dtype: array.size for dtype, array in arrays.items()}
    return _decode(document["tree"], arrays, left)


def _check_sizes(archive: zipfile.ZipFile) -> None:
    """See that nothing grows when it is read: members are stored as they are, and no longer together than the file."""
    assert archive.fp is not None
    infos = archive.infolist()
    if any(info.compress_type != zipfile.ZIP_STORED for info in infos):
        raise ValueError("its members are compressed")
    archive.fp.seek(0, os.SEEK_END)
    size = archive.fp.tell()
    if size > MAX_BYTES:
        raise ValueError(f"it has {size} bytes; if you trust it, raise sb3_skillgraph.saving.MAX_BYTES ({MAX_BYTES})")
    if len({info.filename for info in infos}) < len(infos) or sum(info.file_size for info in infos) > size:
        raise ValueError("its members are longer than the file, or have the same name")


def _read_array(file: io.BytesIO) -> np.ndarray:
    """Read an array whose header promises what there is."""
    version = np.lib.format.read_magic(file)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read_header(file)
    if math.prod(shape) * dtype.itemsize != len(file.getvalue()) - file.tell():
        raise ValueError(f"an array's header promises the shape {shape}, but there is something else")
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False)
