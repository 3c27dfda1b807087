"""Normal equations of a spline camera: by the 4 × 4 knots that each image point touches, and dense.

    python benchmarks/spline.py [--columns N] [--rows N] [--images N] [--json FILE]

Images of a board of 40 × 25 points, known exactly, by a camera of COLUMNS × ROWS knots over 90°,
every knot with its prior. The output gives the seconds to compile and to compute the normal
equations once, peak memory after each, and the largest difference of the two relative to the
largest element of a block. Exit status 1 if they differ by more than 1e-11, or the dense ones are
faster.
"""

import dataclasses
import resource
import sys
import time

import machine


def network(columns: int, rows: int, images: int):
    """The network, with start values that are true but for the noise."""
    import numpy as np

    import jaxbundle
    from jaxbundle.cameras import get_model
    from jaxbundle.geometry import matrix_from_omega_phi_kappa

    model, random = get_model(f"spline-{columns}x{rows}-90"), np.random.default_rng(0)
    board = jaxbundle.Board(40, 25, 0.02)
    angles = random.uniform(-0.4, 0.4, (images, 3)) * [1, 1, 4]
    M = np.array([np.asarray(matrix_from_omega_phi_kappa(a)) for a in angles])
    away = random.uniform(0.5, 0.9, (images, 1)) * M[:, 2] + random.uniform(-0.1, 0.1, (images, 3))
    X0 = board.points.mean(0) + away
    x, y, z = np.moveaxis(np.einsum("nij,npj->npi", M, board.points - X0[:, None]), -1, 0)
    u = 2 * np.stack([x, -y], -1) / (np.sqrt(x * x + y * y + z * z) - z)[..., None]
    xy = [959.5, 599.5] + 1200 * u + random.normal(0, 0.1, u.shape)
    view, point = np.nonzero((np.abs(u) < [0.7, 0.4]).all(-1))
    names = np.array([f"image {i}" for i in range(images)], dtype=object)
    ids, at = np.array(board.ids, dtype=object), xy[view, point]
    camera = jaxbundle.Camera(
        "cam", model.name, {"fx": 1200.0, "fy": 1200.0, "cx": 959.5, "cy": 599.5}, model.free,
        dict(model.prior), image_size=(1920, 1200),
    )  # fmt: skip
    exterior = np.concatenate([X0, np.degrees(angles)], 1).T
    return jaxbundle.make_network(
        [camera],
        {"id": names, "camera": ["cam"] * images}
        | dict(zip(("X0", "Y0", "Z0", "omega", "phi", "kappa"), exterior)),
        {"id": ids, "role": ["fixed"] * len(ids)} | dict(zip("XYZ", board.points.T)),
        {"image": names[view], "point": ids[point], "x": at[:, 0], "y": at[:, 1],
         "sx": np.full(len(at), 0.1), "sy": np.full(len(at), 0.1)},
        datum="control", residuals="measured", angle_unit="deg", image_unit="px",
    )  # fmt: skip


def main() -> int:
    parser = machine.parser_of(__doc__)
    parser.add_argument("--columns", type=machine.positive, default=20)
    parser.add_argument("--rows", type=machine.positive, default=14)
    parser.add_argument("--images", type=machine.positive, default=20)
    parser.add_argument("--json", type=machine.target, help="file for the figures; - for stdout")
    options = parser.parse_args()
    import jax
    import numpy as np

    import jaxbundle
    from jaxbundle.leastsquares.equations.normal import normal_equations
    from jaxbundle.leastsquares.indexing.rows import lay_out_data
    from jaxbundle.leastsquares.problem import pad_data

    jaxbundle.enable_x64()
    given = network(options.columns, options.rows, options.images)
    system = jaxbundle.make_problem(given)
    data, found, wrong = pad_data(system, system.data), {}, []
    figures = {"machine": machine.machine(), "image points": len(given.observations.xy),
               "knots": options.columns * options.rows}  # fmt: skip
    kinds = tuple(
        (name, dataclasses.replace(kind, local=None)) for name, kind in system.declared.named_kinds
    )
    dense = dataclasses.replace(system.declared, named_kinds=kinds)
    for name, declared in (("touched", system.declared), ("dense", dense)):
        def equations(data, declared=declared):
            laid = lay_out_data(system.plan, data)
            return normal_equations(declared, system.plan, data.start, laid)

        begin = time.perf_counter()
        compiled = jax.jit(equations).lower(data).compile()
        compiling, times = time.perf_counter() - begin, []
        for _ in range(4):
            begin = time.perf_counter()
            found[name] = jax.block_until_ready(compiled(data))
            times.append(time.perf_counter() - begin)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        figures[name] = {"compile_s": round(compiling, 1), "s": round(min(times), 3),
                         "peak_gb": round(peak, 2)}  # fmt: skip
    difference = max(
        float(np.abs(a - b).max() / max(np.abs(b).max(), 1e-300))
        for a, b in zip(*map(jax.tree.leaves, found.values()), strict=True)
    )
    figures["difference"] = difference
    if difference > 1e-11:
        wrong.append(f"they differ by {difference:.1g}")
    if figures["touched"]["s"] > figures["dense"]["s"]:
        wrong.append("the dense ones are faster")
    if options.json != "-":
        print(machine.in_words(figures["machine"]))
        print(*(f"{name} {value};" for name, value in figures.items() if name != "machine"))
    machine.write_json(figures, options.json)
    return machine.verdict(wrong)


if __name__ == "__main__":
    sys.exit(main())
