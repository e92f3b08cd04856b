"""Textbook EKF-SLAM with the re-projection gate (RE) and virtual correction (VC), in plain NumPy.

Everything is literal: one mean x and one dense covariance P that grow and shrink with the map, measurement Jacobians
with their zeros, one full-state update per feature, and a full copy of the whole filter per virtual correction.
"(n)" cites the paper's equation n; the derivatives come from complex steps (`geometry.jacobians`).

The state is x = [robot 7, sensor 7, landmark, landmark, ...] (2), P its covariance (3); a landmark takes 7 rows (AHP)
or 3 (Euclidean). Within a frame the two quaternions q are kept raw, as the corrections leave them; whatever needs a
rotation uses q / |q|, and its Jacobian contains the derivative of that. Once per frame, after all corrections, q
becomes q / |q| and P follows.
"""

import copy
from dataclasses import dataclass

import numpy as np

from . import geometry as geo

ROBOT, SENSOR, VEHICLE = slice(0, 7), slice(7, 14), slice(0, 14)
QUATERNIONS = slice(3, 7), slice(10, 14)


@dataclass(frozen=True)
class Options:
    """Choices and numbers of the filter; the defaults are the paper's scenario under VC."""

    gate: str = "VC"  # "RE" | "VC"
    th1: float = 9.0
    th2: float = 9.0
    prior: str = "corrected"  # VC only: the gate and the virtual copies at the "corrected" or the "predicted" state
    scalar_jacobians: bool = False  # d(v/|v|)/dv = I/|v| (True), or exact (I - u u^T)/|v| (False)
    pixel_std: float = 1.0  # px
    oscillation_std: float = 0.0  # m, of the sensor's commanded y per frame
    max_updates: int = 10
    births_first: int = 10  # births in the first frame
    births: int = 1  # births in every other frame
    inverse_depth: float = 0.01  # 1/m
    inverse_depth_std: float = 0.5  # 1/m
    inverse_depth_min: float = 0.001  # 1/m
    linearity: float = 0.1
    birth_margin: float = 25.6  # px
    min_searches: int = 10
    min_match_ratio: float = 0.1
    min_inlier_ratio: float = 0.5
    image: tuple = (640, 480)  # px

    def __post_init__(self):
        """Refuses names that would silently mean something else."""
        if self.gate not in ("RE", "VC") or self.prior not in ("corrected", "predicted"):
            raise ValueError(f"unknown gate {self.gate!r} or prior {self.prior!r}")


@dataclass
class Frame:
    """What the filter reads at one instant."""

    odometry: np.ndarray  # (6,) position and rotation vector in the robot frame
    odometry_cov: np.ndarray  # (6, 6)
    sensor_shift: np.ndarray  # (3,) commanded displacement of the sensor in the robot frame
    ids: np.ndarray  # (m,) int
    uv: np.ndarray  # (m, 2) px


@dataclass(eq=False)
class Landmark:
    """The book-keeping of one landmark; its mean and covariance are in the state."""

    id: int
    size: int = 7  # rows in the state: 7 AHP, 3 Euclidean
    searched: int = 1
    matched: int = 1
    inliers: int = 1
    visible: bool = True  # by its last projection

    @property
    def kind(self):
        """Its parametrisation, "ahp" or "euclidean"."""
        return "ahp" if self.size == 7 else "euclidean"


@dataclass
class Result:
    """One frame: the state at its end, and what was decided on the way."""

    robot: np.ndarray  # (7,)
    sensor: np.ndarray  # (7,)
    P: np.ndarray  # (14, 14) of robot and sensor
    landmarks: dict  # id -> (kind, x, P_ll)
    counters: dict  # id -> (searched, matched, inliers)
    candidates: list  # dicts, see `EkfSlam.select`, in order of correction
    deleted_dynamic: list  # ids
    deleted_inconsistent: list  # ids
    born: list  # ids
    predicted_x: np.ndarray  # (14,) robot and sensor after prediction
    predicted_P: np.ndarray  # (14, 14)
    full_x: np.ndarray  # (N,)
    full_P: np.ndarray  # (N, N)


def run(options, intrinsics, robot0, sensor0, cov0, frames):
    """One `Result` per frame, from robot0 (7,), sensor0 (7,), their covariance (14, 14), intrinsics [u0 v0 au av]."""
    slam = EkfSlam(options, intrinsics, robot0, sensor0, cov0)
    return [slam.step(frame) for frame in frames]


class EkfSlam:
    """The filter: x (N,), P (N, N) and the landmarks in state order."""

    def __init__(self, options, intrinsics, robot0, sensor0, cov0):
        """An empty map around robot0 (7,), sensor0 (7,) with covariance cov0 (14, 14)."""
        self.options = options
        self.intrinsics = np.asarray(intrinsics, float)
        self.x = np.concatenate([robot0, sensor0]).astype(float)
        self.P = np.array(cov0, float)
        self.landmarks = []
        self.is_first_frame = True

    def step(self, frame):
        """One frame: predict, gate and correct, recover or call dynamic, delete, give birth."""
        o = self.options
        measured = {int(i): np.asarray(y, float) for i, y in zip(frame.ids, frame.uv, strict=True)}

        self.predict(frame)
        predicted_x, predicted_P = self.x[VEHICLE].copy(), self.P[VEHICLE, VEHICLE].copy()
        candidates = self.select()

        # Gate and virtual prior: the predicted state, frozen, or the running one.
        prior = self.copy() if (o.gate, o.prior) == ("VC", "predicted") else self
        isolated = []
        for c in candidates:
            self[c["id"]].searched += 1
            if c["id"] not in measured:
                continue
            self[c["id"]].matched += 1
            y = measured[c["id"]]
            e, E, _, z, Z, re1 = prior.innovate(c["id"], y)
            c.update(matched=True, e=e, E=E, z=z, Z=Z, re1=re1, accepted=bool(re1 < o.th1))
            if c["accepted"]:
                c["reparametrised"] = self.correct(c["id"], y)
            elif o.gate == "VC":
                isolated.append(c)

        for c in isolated:  # each on its own copy of the prior, none of them corrects it
            c["re1_prior"], c["re2"] = prior.virtual_correction(c["id"], measured[c["id"]])
            c["dynamic"] = bool(c["re1_prior"] - c["re2"] > o.th2)
            c["recovered"] = not c["dynamic"]
        for c in isolated:
            if c["recovered"]:
                c["reparametrised"] = self.correct(c["id"], measured[c["id"]])

        self.normalise_quaternions()
        dynamic = [c["id"] for c in isolated if c["dynamic"]]
        self.delete(dynamic)
        inconsistent = [landmark.id for landmark in self.landmarks if self.is_inconsistent(landmark)]
        self.delete(inconsistent)
        self.P = (self.P + self.P.T) / 2
        born = self.give_birth(measured)

        return Result(
            robot=self.x[ROBOT].copy(),
            sensor=self.x[SENSOR].copy(),
            P=self.P[VEHICLE, VEHICLE].copy(),
            landmarks={m.id: (m.kind, *self.marginal(m)) for m in self.landmarks},
            counters={m.id: (m.searched, m.matched, m.inliers) for m in self.landmarks},
            candidates=candidates,
            deleted_dynamic=dynamic,
            deleted_inconsistent=inconsistent,
            born=born,
            predicted_x=predicted_x,
            predicted_P=predicted_P,
            full_x=self.x.copy(),
            full_P=self.P.copy(),
        )

    # ---- the state and its rows -------------------------------------------------------------------------------------

    def __getitem__(self, landmark_id):
        """The landmark with this id."""
        return next(m for m in self.landmarks if m.id == landmark_id)

    def rows(self, landmark):
        """The landmark's rows of the state, (3,) or (7,) int."""
        start = 14 + sum(m.size for m in self.landmarks[: self.landmarks.index(landmark)])
        return np.arange(start, start + landmark.size)

    def marginal(self, landmark):
        """The landmark's own mean and covariance."""
        rows = self.rows(landmark)
        return self.x[rows], self.P[np.ix_(rows, rows)]

    def copy(self):
        """A full copy: mean, covariance, book-keeping."""
        return copy.deepcopy(self)

    def unit_frame(self, frame):
        """The frame with q / |q|, (7,)."""
        return np.concatenate([frame[:3], geo.unit(frame[3:], self.options.scalar_jacobians)])

    # ---- prediction -------------------------------------------------------------------------------------------------

    def predict(self, frame):
        """x <- f(x, u, n) (6), P <- F_x P F_x^T + F_n N F_n^T (7): odometry, and the sensor's commanded displacement.

        F_x is the identity outside the robot's 7 rows, so only those rows and columns of P are multiplied.
        """
        u = np.asarray(frame.odometry, float)
        F_x, F_n = geo.jacobians(geo.move, self.x[ROBOT], u)
        self.x[ROBOT] = geo.move(self.x[ROBOT], u)
        self.P[ROBOT, :] = F_x @ self.P[ROBOT, :]
        self.P[:, ROBOT] = self.P[:, ROBOT] @ F_x.T
        self.P[ROBOT, ROBOT] += F_n @ frame.odometry_cov @ F_n.T

        self.x[7:10] += frame.sensor_shift
        self.P[8, 8] += self.options.oscillation_std**2

    # ---- measurement ------------------------------------------------------------------------------------------------

    def observe(self, landmark):
        """h(x) (2,) and H_x (2, N) of one landmark at the current state; notes whether it is visible there."""
        rows = self.rows(landmark)

        def pixel(robot, sensor, point):
            return geo.project(self.unit_frame(robot), self.unit_frame(sensor), point, self.intrinsics)

        parts = self.x[ROBOT], self.x[SENSOR], self.x[rows]
        e = pixel(*parts)
        H = np.zeros((2, len(self.x)))
        H[:, ROBOT], H[:, SENSOR], H[:, rows] = geo.jacobians(pixel, *parts)

        depth = geo.depth(self.unit_frame(parts[0]), self.unit_frame(parts[1]), parts[2])
        landmark.visible = bool(np.all((e >= 0) & (e <= self.options.image)) and depth > 0)
        return e, H

    def project_covariance(self, H):
        """E = H P H^T, (2, 2), over the columns where H is not zero."""
        used = np.flatnonzero(np.any(H != 0, axis=0))
        return H[:, used] @ self.P[np.ix_(used, used)] @ H[:, used].T

    def innovate(self, landmark_id, y):
        """e, E, H, z = y - h(x) (8), Z = H P H^T + W (9) and RE = z^T Z^-1 z (13) (14) at the current state."""
        e, H = self.observe(self[landmark_id])
        E = self.project_covariance(H)
        z = y - e
        Z = E + self.options.pixel_std**2 * np.eye(2)
        return e, E, H, z, Z, z @ np.linalg.solve(Z, z)

    def select(self):
        """The candidates of the frame: of all landmarks predicted visible those with the largest det(H P H^T)."""
        candidates = []
        for landmark in self.landmarks:
            e, H = self.observe(landmark)
            if landmark.visible:
                candidates.append({
                    "id": landmark.id,
                    "matched": False,  # measured in this frame
                    "e": e,  # e, E, z, Z, re1: where the gate was tested; predicted e, E if not matched
                    "E": self.project_covariance(H),
                    "z": np.full(2, np.nan),
                    "Z": np.full((2, 2), np.nan),
                    "re1": np.nan,
                    "re1_prior": np.nan,  # before the virtual update, at its prior
                    "re2": np.nan,  # after the virtual update
                    "accepted": False,
                    "recovered": False,
                    "dynamic": False,
                    "reparametrised": False,
                })  # fmt: skip
        candidates.sort(key=lambda c: -np.linalg.det(c["E"]))  # stable
        return candidates[: self.options.max_updates]

    # ---- correction -------------------------------------------------------------------------------------------------

    def update(self, landmark_id, y):
        """K = P H^T Z^-1 (10), x <- x + K z (11), P <- P - K Z K^T (12); then an inverse depth <= 0 is clamped."""
        _, _, H, z, Z, _ = self.innovate(landmark_id, y)
        K = self.P @ H.T @ np.linalg.inv(Z)
        self.x = self.x + K @ z
        self.P = self.P - K @ Z @ K.T

        landmark = self[landmark_id]
        rho_row = self.rows(landmark)[-1]
        if landmark.kind == "ahp" and self.x[rho_row] <= 0:
            self.x[rho_row] = self.options.inverse_depth_min

    def correct(self, landmark_id, y):
        """Formal correction, linearised at the current state; True if the landmark became Euclidean.

        The linearity index takes the landmark and its variance after the update, robot and sensor from before it.
        """
        robot, sensor = self.unit_frame(self.x[ROBOT]), self.unit_frame(self.x[SENSOR])
        self.update(landmark_id, y)
        landmark = self[landmark_id]
        landmark.inliers += 1
        if landmark.kind == "euclidean":
            return False
        rows = self.rows(landmark)
        index = geo.linearity(robot, sensor, self.x[rows], self.P[rows[-1], rows[-1]])
        if index < self.options.linearity:
            self.reparametrise(landmark)
            return True
        return False

    def virtual_correction(self, landmark_id, y):
        """RE1 (13) at this state and RE2 (14) after an update with y alone, on a full copy: (RE1, RE2).

        W of (14) is R + H+ P+ H+^T, re-projected at the virtual state.
        """
        virtual = self.copy()
        *_, re1 = virtual.innovate(landmark_id, y)
        virtual.update(landmark_id, y)
        *_, re2 = virtual.innovate(landmark_id, y)
        return re1, re2

    def normalise_quaternions(self):
        """q <- q / |q| for robot and sensor, P <- M P M^T with M the derivative of that at the raw q."""
        M = np.eye(14)  # the identity outside the vehicle
        for q in QUATERNIONS:
            (M[q, q],) = geo.jacobians(lambda v: geo.unit(v, self.options.scalar_jacobians), self.x[q])
            self.x[q] = geo.unit(self.x[q])
        self.P[VEHICLE, :] = M @ self.P[VEHICLE, :]
        self.P[:, VEHICLE] = self.P[:, VEHICLE] @ M.T

    # ---- the map ----------------------------------------------------------------------------------------------------

    def reparametrise(self, landmark):
        """AHP -> Euclidean: x <- g(x), P <- G P G^T; the state shrinks by 4 rows."""
        rows = self.rows(landmark)
        first, last = rows[0], rows[-1] + 1
        N = len(self.x)
        (J,) = geo.jacobians(geo.ahp_to_euclidean, self.x[rows])
        G = np.zeros((N - 4, N))
        G[:first, :first] = np.eye(first)
        G[first : first + 3, first:last] = J
        G[first + 3 :, last:] = np.eye(N - last)
        self.x = np.concatenate([self.x[:first], geo.ahp_to_euclidean(self.x[rows]), self.x[last:]])
        self.P = G @ self.P @ G.T
        landmark.size = 3

    def is_inconsistent(self, landmark):
        """The counters' rule, for what is visible and was searched often: seldom matched, or seldom an inlier."""
        o = self.options
        return (
            landmark.visible
            and landmark.searched >= o.min_searches
            and (
                landmark.matched / landmark.searched < o.min_match_ratio
                or landmark.inliers / landmark.matched < o.min_inlier_ratio
            )
        )

    def delete(self, ids):
        """Drops the landmarks and their rows and columns."""
        for landmark_id in ids:
            landmark = self[landmark_id]
            rows = self.rows(landmark)
            self.x = np.delete(self.x, rows)
            self.P = np.delete(np.delete(self.P, rows, axis=0), rows, axis=1)
            self.landmarks.remove(landmark)

    def give_birth(self, measured):
        """Maps the smallest unmapped ids seen well inside the image; returns them."""
        o = self.options
        mapped = {m.id for m in self.landmarks}
        low, high = o.birth_margin, np.array(o.image) - o.birth_margin
        unmapped = [i for i in sorted(measured) if i not in mapped]
        eligible = [i for i in unmapped if np.all((measured[i] >= low) & (measured[i] <= high))]
        born = eligible[: o.births_first if self.is_first_frame else o.births]
        self.is_first_frame = False
        for landmark_id in born:
            self.append(landmark_id, measured[landmark_id])
        return born

    def append(self, landmark_id, y):
        """A new AHP l = g(m, y, rho), m = [robot, sensor]: P_LL = L_m P_mm L_m^T + L_y R L_y^T + L_rho var L_rho^T."""
        o = self.options

        def landmark(robot, sensor, pixel, rho):
            return geo.back_project(robot, sensor, pixel, rho, self.intrinsics, o.scalar_jacobians)

        parts = self.x[ROBOT], self.x[SENSOR], y, np.array([o.inverse_depth])
        L_robot, L_sensor, L_y, L_rho = geo.jacobians(landmark, *parts)
        L_m = np.hstack([L_robot, L_sensor])
        P_LX = L_m @ self.P[VEHICLE, :]
        P_LL = L_m @ self.P[VEHICLE, VEHICLE] @ L_m.T
        P_LL += o.pixel_std**2 * L_y @ L_y.T + o.inverse_depth_std**2 * L_rho @ L_rho.T
        self.x = np.concatenate([self.x, landmark(*parts)])
        self.P = np.block([[self.P, P_LX.T], [P_LX, P_LL]])
        self.landmarks.append(Landmark(landmark_id))
