"""The report says how sure the number of pieces is, and on what each piece rests."""

from __future__ import annotations

import dataclasses

from valveflow_ros.curve.characteristic import Support
from valveflow_ros.report.answer import confidence_table
from valveflow_ros.report.identification import identification_report


def test_confidence_and_support_stand_in_the_page(make):
    plain = make()
    assert 'How probable each number of pieces is' not in identification_report(plain)
    assert 'rests on' not in identification_report(plain)
    c = plain.characteristic
    choice = dataclasses.replace(c.choice, confidence={1: 0.0001, 2: 0.93, 3: 0.0699})
    support = (
        Support(3, 2, 900, (1100.0, 1150.0), True),
        Support(1, 0, 40, (1300.0,), False),
    )
    page = identification_report(
        make(characteristic=dataclasses.replace(c, choice=choice, support=support))
    )
    assert '93.0 %' in page
    assert '7.0 %' in page
    assert '3 steady states at 2 levels, 2 slope responses' in page
    assert page.count('not identifiable by itself') == 1
    assert '1 steady state at 1 level' in page


def test_a_certain_number_says_so(make):
    choice = dataclasses.replace(make().characteristic.choice, confidence={2: 1.0})
    assert 'more than 99.9 %' in confidence_table(choice)
    assert confidence_table(dataclasses.replace(choice, confidence={})) == ''
