"""Source files of tasks, methods and experts from outside, and digests that comments and docstrings do not change.

A digest covers the file named, the modules and packages beside it that it imports, the data files beside these that
they name, and the files that an MJCF names. Installed libraries count by their versions instead (`identity.versions`).
"""

import ast
import hashlib
import inspect
import os
import re
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

from deconfounded import envs
from deconfounded.envs.support import outside
from deconfounded.envs.support.origin import LIBRARIES, OURS, is_library, is_ours

MODELS = ("include", "model")  # MJCF elements that name further MJCF
FILE_NAME = re.compile(r"[^\0\n]{1,200}\.\w{1,12}")
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def last_edit() -> int:
    """The time stamp of the last change of this package's Python files, in ns."""
    return max((file.stat().st_mtime_ns for folder in OURS for file in folder.rglob("*.py")), default=0)


def closure(files: Iterable[Path]) -> set[Path]:
    """The Python files given, and the files outside of this package that they import, directly or not.

    A module is looked for where the imports of a file given start, which is in the path when it runs, and of the file
    that imports it; but in a folder of installed libraries only in the same package.
    """
    reached: set[Path] = set()
    left = [file.resolve() for file in files]
    roots = frozenset(_package(file)[0] for file in left)
    while left:
        file = left.pop()
        if file not in reached and not is_ours(file):
            reached.add(file)
            left += _imports(file, file.stat().st_mtime_ns, roots)
    return reached


@cache
def _imports(file: Path, changed: int, roots: frozenset[Path]) -> tuple[Path, ...]:
    """Files that a file imports, of its own root or of `roots`; `changed`, its time stamp, is there for the cache."""
    own, package = _package(file)
    names: list[str] = []
    for node in ast.walk(ast.parse(file.read_bytes(), str(file))):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join([*above, *([node.module] if node.module else [])])
            names += [module, *(f"{module}.{alias.name}" for alias in node.names)]
    imported: set[Path] = set()
    for parts in (name.split(".") for name in names):
        for root in roots | {own}:
            if root not in LIBRARIES or parts[0] in package[:1]:
                imported |= set(_modules(root, parts))
    return tuple(imported)


def _package(file: Path) -> tuple[Path, tuple[str, ...]]:
    """The folder that a file's imports start from, and the names of the packages that it is in, outermost first."""
    folder, names = file.parent, list[str]()
    while (folder / "__init__.py").is_file():
        names.insert(0, folder.name)
        folder = folder.parent
    return folder, tuple(names)


def _modules(root: Path, parts: list[str]) -> Iterator[Path]:
    """The files under `root` that importing the module `parts` runs: of its packages, then its own."""
    for end in range(1, len(parts) + 1):
        place = root.joinpath(*parts[:end])
        for file in (place / "__init__.py", place.with_suffix(".py")):
            if file.is_file():
                yield file


def mjcf(*files: Path) -> set[Path]:
    """MJCF files, and the files that they include or name: models, meshes, textures, height fields.

    A name is looked for in every folder that MuJoCo may look in: there may be a file too many, but none is missing.
    """
    reached: set[Path] = set()
    elements: list[ElementTree.Element] = []
    left = list(files)
    while left:
        file = Path(os.path.normpath(left.pop()))
        if file in reached or not file.is_file():
            continue
        reached.add(file)
        try:
            elements += ElementTree.fromstring(file.read_bytes()).iter()
        except ElementTree.ParseError:  # MuJoCo says what is wrong with it
            continue
        folders = {one.parent for one in reached}
        left += [
            folder / element.get("file", "") for element in elements for folder in folders if element.tag in MODELS
        ]
    below = {element.get(kind, "") for element in elements for kind in ("meshdir", "texturedir", "assetdir")}
    names = {value for element in elements for key, value in element.items() if key.startswith("file")}
    names |= {Path(name).name for name in names}  # strippath
    places = (file.parent / folder / name for file in tuple(reached) for folder in below for name in names)
    return reached | {Path(os.path.normpath(place)) for place in places if place.is_file()}


@cache
def _names(file: Path, changed: int) -> tuple[str, ...]:
    """Texts in a Python file that may be names of files other than Python's; `changed` as above."""
    texts = (node.value for node in ast.walk(ast.parse(file.read_bytes(), str(file))) if isinstance(node, ast.Constant))
    names = {text for text in texts if isinstance(text, str) and FILE_NAME.fullmatch(text)}
    return tuple(sorted(name for name in names if not name.endswith(".py")))


def with_data(files: set[Path]) -> set[Path]:
    """Python files, and the files beside them, or in a folder there, that they name: weights, tables, MJCF."""
    named = {
        folder / name
        for file in files
        if (names := _names(file, file.stat().st_mtime_ns))
        for folder in (file.parent, *file.parent.glob("*/"))
        for name in names
    }
    return files | mjcf(*(place for place in named if os.path.isfile(place)))  # also of names that no file can have


def of_task(task: envs.Task) -> set[Path]:
    """The files of a task from outside: its classes' modules, what these import, and its MJCF; none for one of ours."""
    classes = {file for cls in type(task).__mro__ if (file := outside.source(cls)) and not is_ours(file)}
    own = {file for file in classes if not is_library(file)}
    if not own:
        return set()
    return with_data(closure(own)) | mjcf(task.home / f"{task.name}.xml")


def of_reference(reference: str) -> set[Path]:
    """The files of a method or expert from outside, `path/file.py:name` or `package.module:name`."""
    file = outside.file(reference)
    return with_data(closure([file])) if file else set()


def digest(files: Iterable[Path], name: str = "") -> str:
    """SHA-256 of files' names and contents, wherever they lie; of Python files without comments and docstrings.

    name: of the object in them, where a file defines several.
    """
    total = hashlib.sha256(name.encode())
    for named, held in sorted((file.name, content(file)) for file in files):
        total.update(os.fsencode(named) + b"\0" + held)
    return total.hexdigest()


def content(file: Path) -> bytes:
    """A file's bytes; of a Python file its syntax tree without docstrings, which comments and layout do not change."""
    return _code(file, file.stat().st_mtime_ns) if file.suffix == ".py" else file.read_bytes()


@cache
def _code(file: Path, changed: int) -> bytes:
    """The content of a Python file; `changed` as above."""
    tree = ast.parse(file.read_bytes(), str(file))
    for node in ast.walk(tree):
        if isinstance(node, DOCUMENTED) and ast.get_docstring(node, clean=False) is not None:
            node.body = node.body[1:]
    return ast.dump(tree).encode()


def of_code(*objects: object) -> str:
    """SHA-256 of the modules that define functions or classes of this package, without comments and docstrings."""
    return digest({Path(inspect.getfile(one)).resolve() for one in objects})  # type: ignore[arg-type]


@cache
def package() -> str:
    """SHA-256 of this whole package: whether two machines have the same of it installed."""
    every = (file for folder in OURS for file in folder.rglob("*") if file.suffix in (".py", ".xml", ".safetensors"))
    return digest(file for file in every if "studies" not in file.parts)  # which a wheel has not
