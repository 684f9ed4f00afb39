"""Conventions that make KFAS and statsmodels look different: the constant of the diffuse likelihood.

The flow of the Nile at Aswan, 1871 to 1970, in 10^8 m^3 (Cobb, 1978), with the variances of Durbin and Koopman (2012),
section 2.10.3; log-likelihood and last level as KFAS gives them (Helske, 2017).
"""

import numpy as np
import pytest

from driftfit import Kalman, Regression, track

TEXT = (
    "1120 1160 963 1210 1160 1160 813 1230 1370 1140 995 935 1110 994 1020 960 1180 799 958 1140 1100 1210 1150 "
    "1250 1260 1220 1030 1100 774 840 874 694 940 833 701 916 692 1020 1050 969 831 726 456 824 702 1120 1100 832 "
    "764 821 768 845 864 862 698 845 744 796 1040 759 781 865 845 944 984 897 822 1010 771 676 649 846 812 742 "
    "801 1040 860 874 848 890 744 749 838 1050 918 986 797 923 975 815 1020 906 901 1170 912 746 919 718 714 740 "
)
NILE = np.array([float(word) for word in TEXT.split()])
Q, R = 1469.1, 15098.5


@pytest.fixture(scope="module")
def level():
    return track(Regression(0, intercept=True), Kalman(q=Q, r=R), NILE)


def test_the_published_numbers_of_the_nile(level):
    assert level.loglik == pytest.approx(-632.5456, abs=5e-5)
    assert level.theta[-1, 0] == pytest.approx(798.3703, abs=2e-3)
    assert level.std[-1, 0] ** 2 == pytest.approx(4032.158, rel=1e-4)


def test_statsmodels_counts_the_diffuse_directions(level):
    """Its local level agrees; that p0 holds before the first step of the drift is in `test_textbook`."""
    structural = pytest.importorskip("statsmodels.tsa.statespace.structural")
    theirs = structural.UnobservedComponents(NILE, "llevel", use_exact_diffuse=True).smooth([R, Q])
    assert theirs.llf == pytest.approx(level.loglik - 0.5 * np.log(2.0 * np.pi), abs=1e-9)
    assert theirs.filtered_state[0] == pytest.approx(level.theta[:, 0], rel=1e-10)
    assert theirs.filtered_state_cov[0, 0] == pytest.approx(level.std[:, 0] ** 2, rel=1e-10)
