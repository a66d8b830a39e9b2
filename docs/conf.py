"""The documentation site. Built by `sphinx-build -W --keep-going -b html docs build/site`.

Formulas become MathML, which browsers draw without scripts, fonts or a network.
"""

import re
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.transforms import SphinxTransform
from sphinx.util import logging
from sphinx.writers.html5 import HTML5Translator

import jaxsmw

logger = logging.getLogger(__name__)

project = "jaxsmw"
author = "The jaxsmw authors"
release = version = jaxsmw.__version__
html_title = f"jaxsmw {release}"
html_theme = "furo"
html_static_path = ["style.css"]
html_css_files = ["style.css"]
html_copy_source = False
html_show_copyright = False
html_show_sphinx = False
exclude_patterns = ["**/.ipynb_checkpoints"]

extensions = ["myst_nb", "sphinx.ext.autodoc"]
myst_enable_extensions = ["dollarmath", "colon_fence"]
# Links to headings work as on GitHub.
myst_heading_anchors = 3
html_math_renderer = "mathml"

nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 600

# Every name of this library in docstrings and pages must exist.
nitpicky = True
# Type variables and private classes have no entry in the reference.
nitpick_ignore_regex = [
    ("py:.*", r"(?!jaxsmw\b).*"),
    ("py:class", r"jaxsmw\.[\w.]*(StateT|PreparedT|\.(Side|Carry|Value|_\w+))"),
]
default_role = "code"
autodoc_class_signature = "mixed"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autodoc_typehints_format = "short"
autodoc_type_aliases = {"ArrayLike": "ArrayLike"}
add_module_names = True
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
toc_object_entries_show_parents = "hide"

# The modules of public names. A name that several modules have is documented under the first of them.
_MODULES = (
    "jaxsmw",
    "jaxsmw.banks",
    "jaxsmw.functional_maps",
    "jaxsmw.learning",
    "jaxsmw.geometry",
    "jaxsmw.io",
    "jaxsmw.transfer",
    "jaxsmw.collection",
    "jaxsmw.evaluation",
    "jaxsmw.benchmark",
)
# Maps each public name to its documented path.
_PUBLIC: dict[str, str] = {}
# Maps all other paths of public objects to the documented paths. An object has other paths if several public
# modules export the object, or if a different module defines the object.
_ORIGINS: dict[str, str] = {}
for _module in map(import_module, _MODULES):
    for _name in _module.__all__:
        _value = getattr(_module, _name)
        if isinstance(_value, ModuleType):
            continue
        _path = f"{_module.__name__}.{_name}"
        _documented = _PUBLIC.setdefault(_name, _path)
        if _path != _documented:
            _ORIGINS[_path] = _documented
        if hasattr(_value, "__qualname__"):
            _ORIGINS[f"{_value.__module__}.{_value.__qualname__}"] = _documented


class LinkCode(SphinxTransform):
    """Links inline code that is a public name, such as `Meyer` or `Meyer(8)`, to its place in the reference.

    Code that begins with `jaxsmw.` must name something.
    """

    default_priority = 600

    def apply(self, **_: Any) -> None:
        for literal in list(self.document.findall(nodes.literal)):
            found = re.fullmatch(r"(jaxsmw\.)?((?:\w+\.)*\w+)(?:\(.*\))?", literal.astext(), re.DOTALL)
            if found is None or any(isinstance(parent, nodes.reference) for parent in _parents(literal)):
                continue
            dotted = found[2]
            target = _PUBLIC.get(dotted.partition(".")[0])
            if found[1] and (target is None or not _exists(dotted)):
                target = f"jaxsmw.{dotted}"  # Sphinx warns if there is no such name
            if target is not None:
                link = addnodes.pending_xref(
                    "", refdomain="py", reftype="obj", reftarget=target, refdoc=self.env.docname
                )
                literal.replace_self(link)
                link += literal


def _parents(node: nodes.Node) -> Iterator[nodes.Node]:
    while node.parent is not None:
        node = node.parent
        yield node


def _exists(dotted: str) -> bool:
    """Whether `jaxsmw.dotted` is a module, or the path of an object in a module."""
    value: Any = jaxsmw
    path = "jaxsmw"
    for name in dotted.split("."):
        path += f".{name}"
        if hasattr(value, name):
            value = getattr(value, name)
        elif isinstance(value, ModuleType) and find_spec(path):
            value = import_module(path)
        else:
            return name in getattr(value, "__dataclass_fields__", ())
    return True


def name_tables(app: Sphinx, document: str, content: list[str]) -> None:
    """Gives each table the name of its run, because several runs on one data set have the same title."""
    if re.fullmatch(r"results/.*/summary", document):
        run = document.removeprefix("results/").removesuffix("/summary")
        content[0] = content[0].replace(content[0].partition("\n")[0], f"# {run}", 1)


def resolve_origin(
    app: Sphinx, env: BuildEnvironment, node: addnodes.pending_xref, content: nodes.Element
) -> nodes.Node | None:
    """Links a name to the entry of its documented path.

    The name may begin with the module that defines the object, or with another module that exports it.
    """
    if node.get("refdomain") != "py":
        return None
    target = node["reftarget"]
    public = _ORIGINS.get(target)
    if public is None:
        # Modules and private helpers have no entry in the reference. If they exist, pages may mention them
        # without a link.
        named = node.get("reftype") == "obj" and target.startswith("jaxsmw.")
        return content if named and _exists(target.removeprefix("jaxsmw.")) else None
    domain = env.domains.python_domain
    return domain.resolve_xref(env, node["refdoc"], app.builder, "obj", public, node, content)


def shorten_signature(
    app: Sphinx, what: str, name: str, value: Any, options: Any, signature: str | None, returns: str | None
) -> tuple[str | None, str | None]:
    """Replaces defaults and names that Sphinx cannot parse."""
    short = (
        text and re.sub(r"TypeAliasForwardRef\('(\w+)'\)", r"\1", text.replace("<factory>", "..."))
        for text in (signature, returns)
    )
    return next(short), next(short)


def shorten_arrays(app: Sphinx, domain: str, kind: str, content: addnodes.desc_content) -> None:
    """Writes `Float[Array, 'n k']` without the module of jaxlib that defines arrays."""
    for signature in content.parent.findall(addnodes.desc_signature):
        for text in list(signature.findall(nodes.Text)):
            if "jaxlib._jax." in text:
                text.parent.replace(text, nodes.Text(text.replace("jaxlib._jax.", "")))


def describe_results(app: Sphinx, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    """Lists the members of `RESULTS` with their sentences."""
    if name == "jaxsmw.RESULTS":
        members = (member for member in vars(value) if not member.startswith("_"))
        lines += [f"- ``{member}``: {value[getattr(value, member)]}" for member in members] + [""]


def check_complete(app: Sphinx, env: BuildEnvironment) -> None:
    """Warns about public names that the reference lacks."""
    missing = sorted(set(_PUBLIC.values()) - set(env.domains.python_domain.objects))
    if missing:
        logger.warning("the reference lacks %s: add them to a page in docs/api", ", ".join(missing))


def to_mathml(node: nodes.math | nodes.math_block, display: str) -> str:
    mathml = convert(node.astext(), display=display)
    # The converter copies commands that it does not know.
    if re.search(r"<m[ion][^>]*>(\\|&<|&amp;|&#x0002A;)", mathml):
        logger.warning("latex2mathml does not know all of this formula: %s", node.astext(), location=node)
    return mathml


def visit_math(translator: HTML5Translator, node: nodes.math) -> None:
    translator.body.append(to_mathml(node, "inline"))
    raise nodes.SkipNode


def visit_displayed_math(translator: HTML5Translator, node: nodes.math_block) -> None:
    translator.body.append(translator.starttag(node, "div", CLASS="math"))
    translator.body.append(to_mathml(node, "block") + "</div>\n")
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_html_math_renderer("mathml", (visit_math, None), (visit_displayed_math, None))
    app.add_transform(LinkCode)
    app.connect("source-read", name_tables)
    app.connect("missing-reference", resolve_origin)
    app.connect("autodoc-process-signature", shorten_signature)
    app.connect("autodoc-process-docstring", describe_results)
    app.connect("object-description-transform", shorten_arrays)
    app.connect("env-check-consistency", check_complete)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
