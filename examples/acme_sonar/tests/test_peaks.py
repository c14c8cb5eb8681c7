from acme_sonar.peaks import Peaks
from fls_flow.testing import check_node, sample_firings


def test_peaks_keeps_the_contract_of_a_node():
    check_node(Peaks())


def test_a_bright_cell_is_found():
    ping = sample_firings(Peaks)[0]["ping"]
    found = Peaks()(ping)
    assert 30.0 in found.amplitude
