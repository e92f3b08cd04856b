"""The experiments behind the cells: the numbers of the paper's Table 1 and section 4."""

import numpy as np

import vcjax as vc
from vcjax.study.paper import cells
from vcjax.study.reproduce import cell_experiment
from vcjax.study.results import describe


def test_there_is_one_for_each_of_the_papers_27_cells_and_the_9_it_left_out():
    described = {str(describe(cell_experiment(cell))) for cell in cells()}
    assert len(cells()) == len(described) == 36


def test_experiments_have_the_papers_numbers():
    for cell in cells():
        experiment = cell_experiment(cell)
        scenario, config = experiment.scenario, experiment.config
        assert scenario.num_frames == 160 and scenario.frame_rate_hz == 10
        assert (len(scenario.landmarks_m), len(scenario.movers.ids)) == (162, 6)
        assert scenario.oscillation.amplitude_m == (0.05 if cell.oscillating else 0.0)
        assert scenario.oscillation.frequency_hz == 3
        assert scenario.movers.speed_m_s == (cell.dynamic_speed_m_s or 0.0)
        if cell.dynamic_motion is not None:
            assert (
                tuple(scenario.movers.direction)
                == {"lateral": (0, 1, 0), "inverse_forward": (-1, 0, 0)}[cell.dynamic_motion]
            )
        np.testing.assert_array_equal(scenario.odometry_std, [0.005, 0.005, 0, 0, 0, 0.05])
        assert scenario.pixel_std_px == config.pixel_std_px == 1
        turned = {"forward": (0.05, 0, 0), "curved": (0.05, 0, 0.5), "lateral": (0, 0.05, 0)}[cell.robot_motion]
        np.testing.assert_array_equal(scenario.increment, turned)
        assert type(config.gate) is {"RE": vc.ReprojectionError, "VC": vc.VirtualCorrection}[cell.gate]
        assert config.gate.th1 == 9 and getattr(config.gate, "th2", 9) == 9
        assert (config.max_updates, config.births_first_frame, config.births_per_frame) == (10, 10, 1)
        assert (config.inverse_depth_mean, config.inverse_depth_std, config.linearity_max) == (0.01, 0.5, 0.1)
