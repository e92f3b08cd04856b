"""The reference itself: geometry against golden functions, filter against a golden run, verdicts against the rules."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from . import geometry as geo
from .ekf_slam import Frame, Options, run

GOLDEN = Path(__file__).resolve().parent.parent / "golden"
INTRINSICS = np.array([320.0, 240.0, 320.0, 320.0])
DRIFTING = [23, 24, 31, 40]  # often selected in the golden run


@cache
def golden(name):
    """The contents of a golden file."""
    return json.loads((GOLDEN / name).read_text())


# ---- geometry -------------------------------------------------------------------------------------------------------


def unit_scalar(v):
    return geo.unit(v, scalar_jacobian=True)


def vec_of_matrix(q):
    """vec R(q), (9,), column by column."""
    return geo.q_to_matrix(q).swapaxes(0, 1).reshape(9, -1).squeeze()


def back_project_scalar(robot, sensor, k, pixel, rho):
    return geo.back_project(robot, sensor, pixel, rho, k, scalar_jacobian=True)


def project(robot, sensor, k, landmark):
    return geo.project(robot, sensor, landmark, k)


# golden name: function, names of its arguments, of its value, of its Jacobians (None: not in the golden file)
FUNCTIONS = {
    "q2R": (vec_of_matrix, ["q"], "R", ["R_q"]),
    "qProd": (geo.q_product, ["q1", "q2"], "q", ["Q_q1", "Q_q2"]),
    "v2q": (geo.q_from_rotation_vector, ["v"], "q", ["Q_v"]),
    "e2q": (geo.q_from_euler, ["e_rpy"], "q", ["Q_e"]),
    "normvec_scalar": (unit_scalar, ["v"], "vn", ["J_scalar_method"]),
    "fromFrame": (geo.from_frame, ["F", "p_F"], "p_W", ["J_F", "J_p"]),
    "toFrame": (geo.to_frame, ["F", "p_W"], "p_F", ["J_F", "J_p"]),
    "odo3": (geo.move, ["F", "u"], "F_out", ["F_r", "F_u"]),
    "projEuc": (project, ["rob", "sen", "k", "p"], "pix", ["U_r", "U_s", "U_k", "U_l"]),
    "projAhm": (project, ["rob", "sen", "k", "ahm"], "pix", ["U_r", "U_s", "U_k", "U_l"]),
    "retroAhm": (back_project_scalar, ["rob", "sen", "k", "pix", "rho"], "ahm", ["L_r", "L_s", None, "L_pix", "L_rho"]),
    "ahm2euc": (geo.ahp_to_euclidean, ["ahm"], "p", ["P_ahm"]),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_function_and_its_jacobians_are_golden(name):
    function, arguments, value, jacobians = FUNCTIONS[name]
    for case in golden("functions.json")[name]:
        args = [np.atleast_1d(np.array(case[a], float)) for a in arguments]
        expected = np.array(case[value]).ravel("F")  # column by column: only R is a matrix
        np.testing.assert_allclose(function(*args), expected, rtol=0, atol=1e-10)
        for ours, theirs in zip(geo.jacobians(function, *args), jacobians, strict=True):
            if theirs is not None:
                np.testing.assert_allclose(ours, np.reshape(case[theirs], ours.shape), rtol=0, atol=1e-10)


@pytest.mark.parametrize(("name", "landmark"), [("projEuc", "p"), ("projAhm", "ahm")])
def test_depth_is_golden(name, landmark):
    for case in golden("functions.json")[name]:
        depth = geo.depth(*(np.array(case[k]) for k in ("rob", "sen", landmark)))
        assert depth == pytest.approx(case["depth"], abs=1e-10)


def test_linearity_is_golden():
    for case in golden("functions.json")["ahmLinearTest"]:
        index = geo.linearity(*(np.array(case[k]) for k in ("rob", "sen", "ahm")), case["var_rho"])
        assert index == pytest.approx(case["Ld"], abs=1e-10)


def test_exact_unit_jacobian_has_no_radial_part():
    v = np.array([0.3, -1.2, 0.5, 2.0])
    u = v / np.linalg.norm(v)
    (exact,) = geo.jacobians(geo.unit, v)
    np.testing.assert_allclose(exact, (np.eye(4) - np.outer(u, u)) / np.linalg.norm(v), rtol=0, atol=1e-15)


# ---- the golden run -------------------------------------------------------------------------------------------------


def golden_frames(drifting=(), drift_px=(0.0, -1.5), first=20):
    """The golden run's frames; the pixels of `drifting` ids leave their true place by `drift_px` more each frame."""
    trace = golden("trace_static_re.json")
    frames = []
    for k, frame in enumerate(trace["frames"]):
        ids, uv = np.array(frame["raw_ids"]), np.array(frame["raw_pix"])
        uv[np.isin(ids, drifting)] += max(0, k - first) * np.array(drift_px)
        frames.append(Frame(np.array(frame["u"]), np.array(trace["init"]["U"]), np.zeros(3), ids, uv))
    return frames


def run_golden(options, frames):
    """The reference over `frames`, from the golden run's start."""
    init = golden("trace_static_re.json")["init"]
    cov0 = np.zeros((14, 14))
    cov0[:7, :7], cov0[7:, 7:] = init["rob_P"], init["sen_P"]
    return run(options, INTRINSICS, init["rob_x"], init["sen_x"], cov0, frames)


@pytest.fixture(scope="module")
def replay():
    return run_golden(Options(gate="RE", scalar_jacobians=True), golden_frames())


def assert_close(ours, theirs):
    """Equal to 1e-8, absolutely."""
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-8)


def test_replay_predicts_and_ends_every_frame_as_golden(replay):
    for ours, theirs in zip(replay, golden("trace_static_re.json")["frames"], strict=True):
        assert_close(ours.predicted_x[:7], theirs["pred_rob_x"])
        assert_close(ours.predicted_x[7:], theirs["pred_sen_x"])
        assert_close(ours.predicted_P[:7, :7], theirs["pred_rob_P"])
        assert_close(ours.robot, theirs["rob_x"])
        assert_close(ours.sensor, theirs["sen_x"])
        assert_close(ours.P[:7, :7], theirs["rob_P"])
        assert_close(ours.P[7:, 7:], theirs["sen_P"])


def test_replay_corrects_the_same_features_with_the_same_numbers(replay):
    for ours, theirs in zip(replay, golden("trace_static_re.json")["frames"], strict=True):
        assert [c["id"] for c in ours.candidates] == [c["id"] for c in theirs["candidates"]]
        for c, g in zip(ours.candidates, theirs["candidates"], strict=True):
            assert (c["matched"], c["accepted"], c["reparametrised"]) == (g["matched"], g["updated"], g["reparam"])
            if c["matched"]:
                for key in "eEzZ":
                    assert_close(c[key], g[key])
                assert_close(c["re1"], g["MD2"])


def test_replay_keeps_the_same_map(replay):
    for ours, theirs in zip(replay, golden("trace_static_re.json")["frames"], strict=True):
        assert (ours.deleted_dynamic, ours.deleted_inconsistent) == ([], theirs["deleted"])
        assert ours.born == theirs["born"]
        if "landmarks" not in theirs:
            continue
        assert list(ours.landmarks) == [g["id"] for g in theirs["landmarks"]]
        for g in theirs["landmarks"]:
            kind, x, P = ours.landmarks[g["id"]]
            assert kind == g["kind"]
            assert list(ours.counters[g["id"]]) == g["counters"]
            assert_close(x, g["x"])
            assert_close(np.diag(P), g["Pdiag"])


def test_sensor_moves_by_its_command_and_only_its_y_becomes_uncertain():
    init = golden("trace_static_re.json")["init"]
    still = Frame(np.zeros(6), np.zeros((6, 6)), np.array([0.0, 0.03, 0.0]), np.zeros(0, int), np.zeros((0, 2)))
    options = Options(oscillation_std=0.002)
    last = run(options, INTRINSICS, init["rob_x"], init["sen_x"], np.zeros((14, 14)), [still, still])[-1]
    np.testing.assert_allclose(last.sensor[:3], np.add(init["sen_x"][:3], [0, 0.06, 0]), rtol=0, atol=1e-15)
    expected = np.zeros((14, 14))
    expected[8, 8] = 2 * 0.002**2
    np.testing.assert_allclose(last.full_P, expected, rtol=0, atol=1e-18)


# ---- verdicts, on the golden run with some features set in motion ---------------------------------------------------


@cache
def drifting_run(options):
    """The golden run with the DRIFTING features in motion."""
    return run_golden(options, golden_frames(DRIFTING))


VC, VC_PREDICTED, RE = Options(), Options(prior="predicted"), Options(gate="RE")


def isolated(results):
    """(result, candidate) of everything that was measured and failed the gate."""
    return [(r, c) for r in results for c in r.candidates if c["matched"] and not c["accepted"]]


@pytest.mark.parametrize("options", [VC, VC_PREDICTED, RE], ids=["corrected", "predicted", "RE"])
def test_state_matches_its_map_and_covariance_is_one(options):
    for r in drifting_run(options):
        assert len(r.full_x) == 14 + sum(len(x) for _, x, _ in r.landmarks.values())
        np.testing.assert_allclose(r.full_P, r.full_P.T, rtol=0, atol=1e-14)
        for q in r.robot[3:], r.sensor[3:]:
            assert np.linalg.norm(q) == pytest.approx(1, abs=1e-14)
    assert np.linalg.eigvalsh(r.full_P)[0] > -1e-14
    # with exact derivatives no variance is left along a unit quaternion
    assert_close(r.P[3:7, 3:7] @ r.robot[3:], 0)


@pytest.mark.parametrize("options", [VC, VC_PREDICTED], ids=["corrected", "predicted"])
def test_vc_verdicts_follow_the_two_thresholds(options):
    results = drifting_run(options)
    for r in results:
        for c in r.candidates:
            assert c["accepted"] == (c["matched"] and c["re1"] < options.th1)
    for _, c in isolated(results):
        assert c["dynamic"] == (c["re1_prior"] - c["re2"] > options.th2)
        assert c["recovered"] == (not c["dynamic"])
        if options.prior == "predicted":
            assert c["re1_prior"] == c["re1"]


@pytest.mark.parametrize("options", [VC, VC_PREDICTED], ids=["corrected", "predicted"])
def test_vc_deletes_dynamic_features_at_once(options):
    results = drifting_run(options)
    for r in results:
        assert r.deleted_dynamic == [c["id"] for c in r.candidates if c["dynamic"]]
        for i in r.deleted_dynamic:
            assert i not in r.landmarks or (i in r.born and r.counters[i] == (1, 1, 1))
    assert set(DRIFTING) <= {i for r in results for i in r.deleted_dynamic}
    assert any(set(r.deleted_dynamic) & set(r.born) for r in results)


def test_recovered_features_are_inliers_and_rejected_ones_are_not():
    for options in (VC, VC_PREDICTED, RE):
        previous = {}
        for r in drifting_run(options):
            for c in r.candidates:
                i = c["id"]
                if i in previous and i in r.landmarks and i not in r.born:
                    gained = np.subtract(r.counters[i], previous[i])
                    assert list(gained) == [1, c["matched"], c["accepted"] or c["recovered"]]
            previous = r.counters


def test_linear_virtual_correction_has_a_closed_form():
    """To first order z+ = R Z^-1 z and H P+ H^T = R - R Z^-1 R, so RE2 needs no update at all (here R = I px^2)."""
    cases = [c for _, c in isolated(drifting_run(VC_PREDICTED))]
    errors = []
    for c in cases:
        Z_inv = np.linalg.inv(c["Z"])
        z_after, W = Z_inv @ c["z"], 2 * np.eye(2) - Z_inv
        errors.append(abs(z_after @ np.linalg.solve(W, z_after) - c["re2"]) / c["re1"])
    assert len(cases) > 20
    assert np.median(errors) < 0.02
    assert max(errors) < 0.1


def test_re_only_marks_and_deletes_by_its_counters():
    results = drifting_run(RE)
    deleted = [i for r in results for i in r.deleted_inconsistent]
    assert set(DRIFTING) <= set(deleted)
    assert not any(c["recovered"] or c["dynamic"] for _, c in isolated(results))
    previous = {}
    for r in results:
        for i in r.deleted_inconsistent:
            searched, matched, inliers = previous[i]
            assert searched + 1 >= RE.min_searches
            assert (inliers + 1) / (matched + 1) < 0.6  # below 0.5 after this frame
        previous = r.counters


def test_without_isolated_features_vc_is_re():
    frames = golden_frames()[:20]
    last = [run_golden(replace(options, th1=np.inf), frames)[-1] for options in (VC, RE)]
    np.testing.assert_array_equal(last[0].full_x, last[1].full_x)
    np.testing.assert_array_equal(last[0].full_P, last[1].full_P)
