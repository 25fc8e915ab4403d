"""What ``terrain measure-slip`` prints."""

from __future__ import annotations

from rich.console import Console

from pipelines.measured_slip.results import MeasuredSlipResult, PredictionFigures
from pipelines.reporting.numbers import format_known
from pipelines.reporting.terminal import compact_table, number_columns, print_lines, text_column
from terrain.measured_slip.delay import Delay, DelayStatus
from terrain.measured_slip.rollers import RollerFindings
from terrain.measured_slip.surfaces import SurfaceSlip

UNLABELLED = "(no label)"


def print_measured_slip(result: MeasuredSlipResult, console: Console) -> None:
    """Print slip by surface, delays, predictions, and which runs have no slip and why."""
    table = compact_table(
        text_column("terrain"),
        *number_columns("runs", "windows", "slip", "95 %", "quartiles", "std", "held out", "wheels", "turn"),
        title=f"slip of {result.robot} over {result.window_s:g} s, measured by {source_words(result)}",
    )
    for row in result.surfaces:
        table.add_row(row.terrain or UNLABELLED, *surface_cells(row))
    console.print(table)
    print_lines(console, [delay_words(name, delay) for name, delay in result.delays.items()])
    if result.predictions:
        console.print(_predictions(result))
    if result.rollers is not None:
        console.print(_rollers(result.rollers))
        print_lines(console, [*roller_words(result.rollers), *named_words(result), *distance_words(result)])
    print_lines(console, _lines(result))


def source_words(result: MeasuredSlipResult) -> str:
    """Return which streams measured the motion from outside, and in how many runs."""
    return ", ".join(f"the stream {name} in {n} runs" for name, n in result.sources.items())


def surface_cells(row: SurfaceSlip) -> tuple[str, ...]:
    """Return the cells of a surface, as screen and page show them."""
    return (
        str(row.n_runs),
        str(row.n_windows),
        format_known(row.slip_ratio, "{:.3f}"),
        f"{format_known(row.interval[0], '{:.3f}')} to {format_known(row.interval[1], '{:.3f}')}",
        f"{format_known(row.spread[0], '{:.3f}')} to {format_known(row.spread[1], '{:.3f}')}",
        format_known(row.std, "{:.3f}"),
        format_known(row.held_out, "{:.3f}"),
        " ".join(format_known(slip, "{:+.2f}") for slip in row.wheel_slip),
        format_known(row.turn_ratio, "{:.2f}"),
    )


def delay_words(session: str, delay: Delay) -> str:
    """Return in a sentence by how much the outside measurement is late."""
    where = f"session {session}: " if session else ""
    if delay.status is DelayStatus.UNDETERMINED:
        return f"{where}no delay of the outside measurement was found, none is taken off"
    return (
        f"{where}the outside measurement is {delay.delay_s:+.3f} s behind the wheels "
        f"(± {1.96 * delay.std_s:.3f}), which is taken off"
    )


def prediction_cells(row: PredictionFigures) -> tuple[str, ...]:
    """Return the cells of a prediction, as screen and page show them."""
    return (
        str(row.n_runs),
        str(row.n_windows),
        f"{row.rms:.4f}",
        f"{format_known(row.rms_interval[0], '{:.3f}')} to {format_known(row.rms_interval[1], '{:.3f}')}",
        f"{row.bias:+.4f}",
        f"{100 * row.coverage:.1f}%",
        f"{row.width:.3f}",
        ", ".join(f"{name} {rms:.3f}" for name, rms in row.by_terrain.items()),
    )


PREDICTION_COLUMNS = ("runs", "windows", "rms", "95 %", "bias", "inside", "width", "by terrain")


def _predictions(result: MeasuredSlipResult) -> object:
    table = compact_table(
        text_column("held out"),
        *number_columns(*PREDICTION_COLUMNS[:-1]),
        text_column(PREDICTION_COLUMNS[-1]),
        title="slip predicted from currents and wheel speeds alone",
    )
    for row in result.predictions:
        table.add_row(row.held_out, *prediction_cells(row))
    return table


def _rollers(found: RollerFindings) -> object:
    table = compact_table(
        text_column("surface"),
        *number_columns("roller friction", "95 %", "slip left", "of"),
        title="friction of the rollers over the stiffness of traction; rms of the slip of held-out runs",
    )
    for cells in roller_cells(found):
        table.add_row(*cells)
    return table


def roller_cells(found: RollerFindings) -> list[tuple[str, ...]]:
    """Return the cells of each surface, as screen and page show them."""
    return [
        (
            name,
            f"{ratio:.3f}",
            f"{found.roller_interval[name][0]:.3f} to {found.roller_interval[name][1]:.3f}",
            f"{found.held_out_rms[name]:.4f}",
            f"{found.plain_rms[name]:.4f}",
        )
        for name, ratio in found.roller_ratio.items()
    ]


def roller_words(found: RollerFindings) -> list[str]:
    """Return in sentences what of the slip is the robot's own."""
    loads = ", ".join(
        f"{load:.3f} ({low:.3f} to {high:.3f})"
        for load, (low, high) in zip(found.load_ratio, found.load_interval, strict=True)
    )
    low, high = found.scale_interval
    lines = [
        f"load of the wheels: {loads}",
        f"slip alike in all directions on all surfaces: {found.scale_error:.3f} ({low:.3f} to {high:.3f}); "
        "the wheels' radius or the scale of the outside measurement, which these runs do not distinguish",
    ]
    for name, other in found.other_loads.items():
        before, after = found.other_rms[name]
        text = ", ".join(f"{load:.3f}" for load in other)
        lines.append(
            f"{name}: the surface is {found.other_surface[name]}, the load of the wheels {text}, by which "
            f"{before:.4f} of rms falls to {after:.4f}"
        )
    return lines


def named_words(result: MeasuredSlipResult) -> list[str]:
    """Return in sentences which surfaces the rollers name."""
    lines = []
    for each in result.named:
        if each.n_right is not None and result.rollers is not None:
            of = "fitted" if each.group in result.rollers.roller_ratio else "not fitted"
            lines.append(f"{each.group}, {of}: {each.n_right} of {each.n_runs} runs are named by their slip")
            continue
        counts = ", ".join(f"{name} {n}" for name, n in sorted(each.windows.items(), key=lambda x: -x[1]))
        lines.append(f"{each.group or UNLABELLED}: windows of {each.n_runs} runs look like {counts}")
    return lines


def distance_words(result: MeasuredSlipResult) -> list[str]:
    """Return in sentences how far the wheels of an omni robot are from its middle, by its turns."""
    return [
        f"{name}: turns are those of wheels {each.distance_m:.4f} m from the middle that turn without slip "
        f"({each.interval_m[0]:.4f} to {each.interval_m[1]:.4f}, {each.n_runs} runs)"
        for name, each in result.distances.items()
    ]


def _lines(result: MeasuredSlipResult) -> list[str]:
    spinning = [name for row in result.surfaces for name in row.spinning]
    lines = []
    if not any(row.n_windows for row in result.surfaces):
        lines.append(
            f"no window of {result.window_s:g} s is covered by the outside measurement; a shorter "
            "--window may be"
        )
    if spinning:
        lines.append(f"a wheel spins or lifts in {len(spinning)} runs: {', '.join(spinning[:8])}")
    if result.not_measured:
        lines.append(
            f"{len(result.not_measured)} of {result.n_runs} runs have no slip, the first: "
            f"{result.not_measured[0]}"
        )
    if result.out is not None:
        lines.append(f"runs with the stream slip written to {result.out}")
    return [*lines, *result.skipped]
