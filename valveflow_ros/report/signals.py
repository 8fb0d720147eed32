"""The signals over time, with the special segments found in them."""

from __future__ import annotations

from valveflow_ros.records import FloatArray, SegmentKind
from valveflow_ros.report.downsample import envelope, segment_path
from valveflow_ros.report.figure import Figure, Spec, packed, rounded, token
from valveflow_ros.report.identified import Identified
from valveflow_ros.report.numbers import counted, duration
from valveflow_ros.report.words import input_unit

_STRETCHES = 5000
_SEGMENT_POINTS = 4000
_KINDS = (
    (SegmentKind.STEADY, 'steady state', 'steady'),
    (SegmentKind.SLOPE, 'slope response', 'slope'),
)


def _panel(data: Identified, values: FloatArray, axis: str, unit: str, places: int) -> list[Spec]:
    """Return the measured signal in grey and its special segments in colour."""
    first = axis == 'y'
    all_of_it = envelope(data.table.time_ns, values, _STRETCHES, data.period_ns)
    traces: list[Spec] = [
        {
            'type': 'scatter', 'mode': 'lines', 'name': 'measured', 'yaxis': axis,
            'x0': all_of_it.start_ns / 1e6, 'dx': all_of_it.step_ns / 1e6,
            'y': rounded(all_of_it.values), 'line': {'color': token('data-soft'), 'width': 1},
            'hoverinfo': 'skip', 'showlegend': first, 'legendgroup': 'measured',
        }
    ]  # fmt: skip
    for kind, name, colour in _KINDS:
        rows = data.rows_of(kind)
        times, means = segment_path(data.table.time_ns, values, rows, _SEGMENT_POINTS)
        traces.append(
            {
                'type': 'scatter', 'mode': 'lines', 'name': name, 'yaxis': axis,
                'x': packed(times), 'y': rounded(means),
                'line': {'color': token(colour), 'width': 2.2},
                'hovertemplate': f'%{{x|%d %b %H:%M}}<br>%{{y:.{places}f}} {unit}'
                f'<extra>{name}</extra>',
                'showlegend': first, 'legendgroup': name,
            }
        )  # fmt: skip
    return traces


def _buttons(days: float) -> Spec | None:
    """Return the buttons that show the last hours or days, where the log is longer."""
    steps: list[Spec] = []
    if days > 0.5:
        steps.append({'step': 'hour', 'count': 6, 'label': 'last 6 h', 'stepmode': 'backward'})
    if days > 2.0:
        steps.append({'step': 'day', 'count': 1, 'label': 'last day', 'stepmode': 'backward'})
    if not steps:
        return None
    steps.append({'step': 'all', 'label': 'all'})
    return {
        'buttons': steps, 'x': 1, 'xanchor': 'right', 'y': -0.16, 'yanchor': 'top',
        'bgcolor': token('panel'), 'activecolor': token('rule'), 'bordercolor': token('rule'),
        'borderwidth': 1, 'font': {'color': token('ink')},
    }  # fmt: skip


def signals_figure(data: Identified) -> Figure:
    """Return u and power over time (the paper's Fig. 5)."""
    unit = input_unit(data.characteristic.pressure_exponent)
    traces = [
        *_panel(data, data.u, 'y', unit, 0),
        *_panel(data, data.power, 'y2', 'MW', 1),
    ]
    table = data.table
    days = (int(table.time_ns[-1]) - int(table.time_ns[0])) / 86400e9 if len(table) else 0.0
    axis: Spec = {'type': 'date', 'anchor': 'y2', 'title': {'text': 'time (UTC)'}}
    if buttons := _buttons(days):
        axis['rangeselector'] = buttons
    layout = {
        'xaxis': axis,
        'margin': {'l': 60, 'r': 12, 't': 34, 'b': 96 if buttons else 46},
        'yaxis': {'domain': [0.54, 1.0], 'title': {'text': f'u ({unit})'}},
        'yaxis2': {'domain': [0.0, 0.48], 'title': {'text': 'power (MW)'}},
    }
    return Figure('signals', _caption(data), _description(data), traces, layout, height=560)


def _share(data: Identified) -> tuple[int, int, float]:
    steady, slope = (len(data.rows_of(kind)) for kind, _, _ in _KINDS)
    rows = data.rows
    return steady, slope, float((rows[:, 1] - rows[:, 0]).sum()) if len(rows) else 0.0


def _caption(data: Identified) -> str:
    steady, slope, samples = _share(data)
    time = duration(samples * data.settings.real('sample_period'))
    return (
        f'<b>Coloured stretches should look straight.</b> '
        f'<span class="key steady">Steady state</span> ({steady}): input and power hold. '
        f'<span class="key slope">Slope response</span> ({slope}): both move along a ramp, '
        'counted only after the turbine has caught up. Together they last '
        f'{time}; everything else (grey) is left out of the search for the pieces. '
        '<span class="mouse">Drag to zoom, double-click to return.</span>'
    )


def _description(data: Identified) -> str:
    steady, slope, _ = _share(data)
    return (
        f'Integrated input and generated power over time with '
        f'{counted(steady, "steady-state segment")} and '
        f'{counted(slope, "slope-response segment")} marked.'
    )
