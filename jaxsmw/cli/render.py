"""`jaxsmw render`: draw a mesh or a correspondence."""

from __future__ import annotations

import argparse

from jaxsmw.cli.arguments import MAP_FORMS, add_partial, add_reading, add_up, path, refuse_without
from jaxsmw.cli.inputs import check_inputs, read_maps, read_meshes
from jaxsmw.cli.outputs import check_outputs, is_page, write_comparison_page, write_figure
from jaxsmw.errors import InputError

HELP = "draw a mesh, or show a correspondence by colours"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("source", type=path, metavar="SOURCE", help="mesh to draw, or source mesh of a map")
    parser.add_argument("target", type=path, metavar="TARGET", nargs="?", help="target mesh of a map")
    parser.add_argument(
        "map",
        type=path,
        metavar="MAP",
        nargs="*",
        help=f"map to show: {MAP_FORMS}; a page may show several maps",
    )
    parser.add_argument(
        "--output",
        metavar="FILE",
        type=path,
        required=True,
        help="file to write: a picture (.png, .pdf or .svg), or an interactive page (.html) of a "
        "correspondence",
    )
    add_partial(parser, with_scale=False)
    add_up(parser)
    add_reading(parser)


def run(options: argparse.Namespace) -> None:
    """Draw a mesh or a correspondence, or write a page with one or several correspondences."""
    page = is_page(options.output)
    _check(options, page)
    from jaxsmw.report.figures import draw_correspondence, draw_mesh

    if not options.map:
        (mesh,) = read_meshes(options.source, weld=options.weld)
        write_figure(options.output, draw_mesh(mesh, up=options.up))
        return
    mesh_x, mesh_y = read_meshes(options.source, options.target, weld=options.weld)
    maps = read_maps(options.map, mesh_x, mesh_y, index_base=options.index_base)
    if page:
        write_comparison_page(
            options.output, mesh_x, mesh_y, maps, {}, partial=options.partial, up=options.up
        )
        return
    (pointwise_map,) = maps.values()
    write_figure(options.output, draw_correspondence(mesh_x, mesh_y, pointwise_map, up=options.up))


def _check(options: argparse.Namespace, page: bool) -> None:
    """Check that the arguments do not contradict each other, and that the outputs can be written."""
    output = options.output
    if options.target and not options.map:
        raise InputError(f"{options.target}: a second mesh needs a map: give the map as the third file.")
    if page and not options.map:
        raise InputError(f"{output}: a page shows a correspondence: give a target mesh and a map as well.")
    if not page and len(options.map) > 1:
        raise InputError(
            f"{output}: a picture shows only one map: leave {options.map[1]} out, or write a page (.html)."
        )
    if not page and options.partial:
        raise InputError(
            f"--partial: has an effect only on pages: leave --partial out, or write {output} as .html."
        )
    refuse_without(options, "a map", bool(options.map), "index_base")
    inputs = [options.source, options.target, *options.map]
    check_inputs(*inputs)
    check_outputs(inputs, figures=[] if page else [output], pages=[output] if page else [])
