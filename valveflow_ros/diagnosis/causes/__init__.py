# Copyright 2026 valveflow maintainers
# SPDX-License-Identifier: Apache-2.0
"""The catalogue of causes, by family; every module-level `Cause` here belongs to it."""

from __future__ import annotations

import functools
import importlib
import pkgutil
import re
from collections.abc import Iterable

from valveflow_ros.diagnosis.cause import Cause
from valveflow_ros.diagnosis.causes.covariate import covariate_cause
from valveflow_ros.diagnosis.grids import Grids
from valveflow_ros.errors import InputError

# The action an operator takes for each cause and each fault of a record, by name.
TO_DO = {
    'backlash': (
        'Have the coupling between stem and plug, the lever and the feedback linkage looked at '
        'in the next stop; measure the play by hand. Until then the position oscillates by the '
        'width of the backlash: set the dead band of the controller larger. With `model_file` '
        'the monitor corrects for the backlash and continues to check the curve.'
    ),
    'choked': (
        'First ask whether the extraction or the first stage behind the valve is fouled: a '
        'higher pressure there has the same effect. If the design of the valve explains it, '
        'nothing is broken: use the extended model, or log the pressure behind the '
        'valve and compare it with `kappa`.'
    ),
    'clock': (
        'Compare the clocks of the two loggers, and turn on NTP or PTP on both. In a historian '
        'look for a tag that is stamped at the server and one that is stamped at the source. '
        'Then import the record again: no maintenance of the valve is needed.'
    ),
    'curve_change': (
        'If both changes are about the same share of the power, ask first for the cooling water, '
        'heaters, extractions and the power meter. If they are not, ask what was done to valves '
        'and controller, and have the valves looked at that open where the power changed most. '
        'If the change was meant, find a new curve and go on with it.'
    ),
    'curve_shape': (
        'A bump where two valves overlap is a matter of their cams or of the table in the '
        'controller: compare its position with the lift diagram. A dent means too little overlap. '
        'It affects only the linearity; `valveflow compensate` gives a table for the '
        'controller that removes the bend.'
    ),
    'curve_step': (
        'Look at the valve that begins to open where the change begins: its lift, its servo, its '
        'linkage, the broken stem. Look into the log of the controller for a changed sequence at '
        'the time named. Watch vibration and metal temperatures: with one valve shut the others '
        'and the first stage are loaded unevenly.'
    ),
    'diurnal': (
        'Usually not a fault: cold cooling water in the night, warm in the afternoon. Log the '
        'pressure in the condenser and see whether it has the same daily variation. If it grows '
        'from one year to the next, look at the condenser: air, fouling, the cooling tower.'
    ),
    'exponent': (
        'First have the pressure transmitter checked, its zero above all: a wrong zero looks '
        'like a wrong exponent. If it is right, set `pressure_exponent` of the monitor to the '
        'value found and let it find the curve anew, or go on with the extended model.'
    ),
    'flatline': (
        'Look at the transmitter, at the input card and at the gateway, which may be repeating '
        'its last value. Only the diagnosis leaves these rows out. A running monitor uses them: '
        'repair the signal, then request a new curve (`~/refit`).'
    ),
    'form': (
        'Check that the model given is of this unit. If it is, find a new curve of this unit and '
        'give that one.'
    ),
    'gain_change': (
        'First ask whether the cooling water was as warm then, if its column was not given. If '
        'it was, and the power fell: '
        'blading, heaters, an open bypass, or the scale of the power meter. If the change was '
        'meant, find a new curve and go on with it.'
    ),
    'gain_drift': (
        'If the power falls: erosion and deposits in the blading, a heater that loses '
        'efficiency, leaking extractions; compare with the heat rate and plan for it. If it '
        'rises: a drift of the power transducer, cleaner blading, colder cooling water. Set a '
        'new reference only after the reason is known.'
    ),
    'gain_step': (
        'Ask what happened at the time named: a feed water heater or an extraction in or out '
        'for good, work on the power meter, its current transformers or its scale. If nothing '
        'did, look for a bypass that is open and for a valve that opens less than its sensor '
        'says. If it was meant, find a new curve (`valveflow identify --from TIME`, in the node '
        '`~/refit`) and set a new reference.'
    ),
    'input_change': (
        'Look into the calibration logs of pressure and position since the model was found, and '
        'check both transmitters against a second instrument. If the new reading is right, find '
        'a new curve; if it is wrong, have it corrected.'
    ),
    'input_drift': (
        'Check pressure and position transmitters against a second instrument; a drift of a per '
        'cent in ten days is an instrument, not a seat. If both are right the seat wears or the '
        'plug is eroded: plan an inspection.'
    ),
    'input_step': (
        'Look into the calibration log of pressure and position at the time named. If the new '
        'reading is the right one, find a new curve and set a new reference. If it is the '
        'wrong one, have it corrected: the load controller works with the same reading.'
    ),
    'intervals': (
        'Log the state of extractions, heaters and auxiliary steam beside the power: it usually '
        'falls on the same hours. If it is intended, nothing is broken: shelve the alarm while '
        'it lasts. A valve that should be shut and is open has the same effect.'
    ),
    'offset_change': (
        'Check the zero of the power transducer, and whether auxiliary load or an extraction is '
        'on that was off when the model was found.'
    ),
    'output_offset_drift': (
        'Check the zero of the power transducer and whether auxiliary load was moved between '
        'the meters. A drift of megawatts that no load explains is an instrument.'
    ),
    'quantisation': (
        'Raise the resolution of the analogue card, or turn down the dead band (exception '
        'deviation) of the historian for the four signals. A ramp that is smaller than one step '
        'cannot be used.'
    ),
    'rate_limit': (
        'Look at oil pressure, filter and pump, at the servo valve and at friction in the stem. '
        'The unit reaches its load, but perhaps too slowly for primary frequency control: test '
        'the response to a step, and tell the grid operator if it is too slow.'
    ),
    'region_lag': (
        'Usually not a fault but physics that the model did not have: more steam is stored '
        'above that load. Let the monitor refit. A change from one month to the next points to '
        'the reheater, its valves, or to another mode of boiler control above that load.'
    ),
    'reheater': (
        'Not a fault: a share of the turbine lies behind the reheater. Use the extended model '
        'for frequency studies, where the first seconds count. If the slow part grew, look at '
        'the intercept valves and the reheater pressure.'
    ),
    'saturation': (
        'Look for a limiter left in the controller, for a mechanical stop, or for a stem that '
        'reaches its end stop. Until it is repaired the unit has less reserve than its '
        'operators believe: tell them the opening named.'
    ),
    'spikes': (
        'Look for a loose terminal, a shield grounded at both ends, or a restart of the '
        'gateway. Only the diagnosis leaves these rows out. If their number rises, repair the '
        'signal before it is lost.'
    ),
    'stiction': (
        'Lubricate, retighten or renew the packing; check the positioner and the oil. Do not '
        'make the integral action of the controller faster: the position would oscillate. With '
        '`valve_command` published the monitor also detects friction before the position sensor.'
    ),
    'temperature': (
        'Hold the temperature better: sprays, burners, the boiler master. If it has to move, '
        'use the extended model. The method assumes a constant temperature; if it varies by '
        'more than `temperature_spread_limit`, the curve has a warning.'
    ),
}


@functools.cache
def catalogue() -> dict[str, Cause]:
    """Return every cause by name, in alphabetical order."""
    modules = [
        importlib.import_module(f'{__name__}.{m.name}') for m in pkgutil.iter_modules(__path__)
    ]
    causes = [
        made for module in modules for made in vars(module).values() if isinstance(made, Cause)
    ]
    return {cause.name: cause for cause in sorted(causes, key=lambda cause: cause.name)}


_NAME = re.compile(r'[A-Za-z]\w{0,39}', re.ASCII)


def check_covariates(names: Iterable[str], where: str = '--covariate') -> None:
    """Raise `InputError` if the name of a covariate is invalid or already has another meaning.

    ``where`` says in the message where the names were given.
    """
    for name in names:
        if not _NAME.fullmatch(name):
            raise InputError(
                f"{where} '{name}': a name has letters, digits and underscores, at most 40."
            )
        if name in catalogue():
            raise InputError(
                f"{where} '{name}' is a cause of the catalogue already; choose another name."
            )


def causes_for(grids: Grids) -> dict[str, Cause]:
    """Return the catalogue for the form of a record plus one cause per covariate, by name."""
    own = {name: covariate_cause(about) for name, (about, _) in grids.covariates.items()}
    return {name: cause.on(grids.form) for name, cause in (catalogue() | own).items()}
