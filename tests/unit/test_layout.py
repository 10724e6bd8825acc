"""The layout of the product packages: one class for one name, modules and folders that can be read."""

import ast
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("featuredb", "ingest", "reloc")
MAX_LINES, MAX_MODULES = 400, 15


def test_a_public_class_name_stands_for_one_class() -> None:
    homes = _homes(_modules(*PACKAGES))
    twice = {name: found for name, found in homes.items() if len(found) > 1}
    assert not twice, f"public classes of one name in several modules, rename all but one: {twice}"


def test_tools_give_no_product_name_to_another_class() -> None:
    product, tools = _homes(_modules(*PACKAGES)), _homes(_modules("tools"))
    taken = {name: (*tools[name], *product[name]) for name in sorted(tools.keys() & product.keys())}
    assert not taken, f"public classes of tools with the name of a product's class, rename them: {taken}"


def test_modules_are_short() -> None:
    lines = {_path(module): len(module.read_text().splitlines()) for module in _modules(*PACKAGES)}
    long = {path: count for path, count in lines.items() if count > MAX_LINES}
    assert not long, f"modules of more than {MAX_LINES} lines, split them: {long}"


def test_folders_hold_few_modules() -> None:
    counts = Counter(_path(m.parent) for m in _modules(*PACKAGES) if m.name != "__init__.py")
    full = {folder: count for folder, count in counts.items() if count > MAX_MODULES}
    assert not full, f"folders of more than {MAX_MODULES} modules, divide them: {full}"


def test_a_module_gives_a_name_to_one_thing() -> None:
    """A second constant or function of one name silently takes the place of the first."""
    twice = {
        f"{_path(module)}: {name}": count
        for module in _modules(*PACKAGES, "tools")
        for name, count in Counter(_bound(ast.parse(module.read_text()))).items()
        if count > 1
    }
    assert not twice, f"names that a module gives to several things: {twice}"


def _bound(module: ast.Module) -> Iterator[str]:
    """Names of functions, classes and values, in the order of the module; of an overload the last alone."""
    for node in module.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            if "overload" not in [ast.unparse(d) for d in node.decorator_list]:
                yield node.name
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            for target in targets:
                for part in ast.walk(target):
                    if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store):
                        yield part.id


def _modules(*folders: str) -> list[Path]:
    found = [module for folder in folders for module in sorted((ROOT / folder).rglob("*.py"))]
    assert found
    return found


def _homes(modules: list[Path]) -> dict[str, list[str]]:
    homes: dict[str, list[str]] = defaultdict(list)
    for module in modules:
        for node in ast.parse(module.read_text()).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes[node.name].append(_path(module))
    return homes


def _path(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()
