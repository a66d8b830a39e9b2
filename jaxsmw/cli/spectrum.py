"""`jaxsmw spectrum`: describe a mesh and compute its eigenbasis."""

from __future__ import annotations

import argparse

from jaxsmw.choices import NUMBER_OF_EIGENVECTORS
from jaxsmw.cli.arguments import add_eigenproblem, add_paths, add_weld, path, refuse_without, whole_number
from jaxsmw.cli.banks import add_bank, make_bank
from jaxsmw.cli.console import show, with_options
from jaxsmw.cli.inputs import check_inputs
from jaxsmw.cli.outputs import check_outputs, report_written, write_figure
from jaxsmw.errors import check_suffix

HELP = "describe a mesh and compute its eigenbasis"

_EIGENVALUES_PER_LINE = 10


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("mesh", type=path, metavar="MESH", help="mesh to describe")
    parser.add_argument(
        "--eigenvectors",
        metavar="N",
        type=whole_number(1),
        default=NUMBER_OF_EIGENVECTORS,
        help="number of eigenvectors (default: %(default)s)",
    )
    add_paths(
        parser,
        {
            "--output FILE": "write the eigenbasis of the surface, scaled to area 1, to this file: a .npz "
            "or .safetensors file with the arrays eigenvalues, eigenvectors and vertex_areas, or a .mat file "
            "with a struct S with the fields evals, evecs, A and surface",
            "--figure FILE": "draw the filters as functions of the eigenvalue to this file (.png, .pdf or "
            ".svg)",
        },
    )
    add_bank(parser)
    add_eigenproblem(parser)
    add_weld(parser)


def run(options: argparse.Namespace) -> None:
    """Describe the mesh, print its eigenvalues, and write the requested files."""
    refuse_without(options, "--figure", bool(options.figure), "bank", "filters")
    check_inputs(options.mesh)
    check_outputs([options.mesh], files=[options.output], figures=[options.figure])
    if options.output:
        from jaxsmw.io.formats.named_arrays import check_writable
        from jaxsmw.io.spectra import SPECTRUM_SUFFIXES

        check_suffix(options.output, "spectra", *SPECTRUM_SUFFIXES)
        check_writable(options.output)
    bank = make_bank(options.bank, options.filters)
    from jaxsmw.geometry.eigenbasis import as_spectrum, eigenpairs
    from jaxsmw.geometry.laplacian import choose_laplacian
    from jaxsmw.geometry.mesh import diagnose
    from jaxsmw.io.meshes import read_mesh

    mesh = read_mesh(options.mesh, weld=options.weld)
    laplacian = choose_laplacian(mesh) if options.laplacian == "auto" else options.laplacian
    pairs = eigenpairs(mesh, options.eigenvectors, laplacian=laplacian, eigensolver=options.eigensolver)
    eigenvalues, _, _ = pairs
    show(with_options("\n".join([*mesh.notes, *diagnose(mesh).sentences()])))
    show(f"area {mesh.area:.6g}, {laplacian} Laplacian; eigenvalues of the surface scaled to area 1:")
    for first in range(0, len(eigenvalues), _EIGENVALUES_PER_LINE):
        row = eigenvalues[first : first + _EIGENVALUES_PER_LINE]
        show(f"{first:5}  {' '.join(f'{value:9.2f}' for value in row)}")
    if options.output:
        import numpy as np

        from jaxsmw.io.spectra import write_spectrum

        write_spectrum(options.output, as_spectrum(mesh, *pairs, dtype=np.float64), mesh)
        report_written(options.output)
    if options.figure:
        from jaxsmw.report.summary import draw_bank

        write_figure(options.figure, draw_bank(bank, eigenvalues))
