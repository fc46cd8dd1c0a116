"""The robot as a Gymnasium environment: its observations are those of the published policy."""

import gymnasium
import mujoco
import numpy as np

PERIOD = 0.02  # s, of a decision
SUBSTEPS = 5


class Go1(gymnasium.Env):
    """Walk at a wanted velocity; the loss is the error of the velocity, at most 1."""

    def __init__(self, path):
        spec = mujoco.MjSpec.from_file(str(path))
        # The meshes are for the eyes alone, and would be a further download.
        for geom in [g for g in spec.geoms if g.type == mujoco.mjtGeom.mjGEOM_MESH or g.meshname]:
            spec.delete(geom)
        for mesh in list(spec.meshes):
            spec.delete(mesh)
        self.model = spec.compile()
        self.model.opt.timestep = PERIOD / SUBSTEPS
        self.data = mujoco.MjData(self.model)
        self.home = np.array(self.model.keyframe("home").qpos)
        self._imu = self.model.site("imu").id
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (48,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (12,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        rng = self.np_random
        mujoco.mj_resetDataKeyframe(self.model, self.data, self.model.keyframe("home").id)
        self.data.qpos[7:] += 0.05 * rng.standard_normal(12)
        self.model.body("trunk").mass[0] = 5.204 * (1 + 0.02 * rng.standard_normal())
        self.wanted = np.array([rng.uniform(0.5, 1.0), 0.0, rng.uniform(-0.3, 0.3)])
        self.last = np.zeros(12)
        mujoco.mj_forward(self.model, self.data)
        return self._row(), {}

    def step(self, action):
        self.data.ctrl[:] = self.home[7:] + 0.5 * np.asarray(action, np.float64)
        for _ in range(SUBSTEPS):
            mujoco.mj_step(self.model, self.data)
        self.last = np.asarray(action, np.float64)
        row = self._row()
        error = np.abs(row[[0, 1]] - self.wanted[:2]).sum() + 0.5 * abs(row[5] - self.wanted[2])
        fallen = bool(row[8] > 0)  # gravity points out of its back
        return row, float(max(0.0, 1.0 - error)), fallen, False, {}

    def _row(self):
        data = self.data
        turned = data.site_xmat[self._imu].reshape(3, 3)
        parts = (
            data.sensor("local_linvel").data,
            data.sensor("gyro").data,
            -turned[2],
            data.qpos[7:] - self.home[7:],
            data.qvel[6:],
            self.last,
            self.wanted,
        )
        return np.concatenate(parts).astype(np.float32)
