"""Makes labelled time series of the reference arm with a hidden effect: physics of its own, to score the gap workflow.

Shares nothing with the product: Newton-Euler in the base frame, LuGre friction at the motors, winding with inductance,
stiff contacts for play, 10 kHz. Needs numba (no dependency of the product):
`python benchmarks/gap_dynamic_cases.py ARM.toml OUT SEED EFFECT [JOINT]` writes OUT/{arm.toml,log.csv.gz,truth.json}.
EFFECT `none`, an effect's name, two joined by `+`, or one that is in no list: `drag`, `cubic`, `resistance`, `spring`,
`position_friction`, `slip`, `warming`.
"""

# mypy: ignore-errors
from __future__ import annotations

import gzip
import json
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

try:
    from numba import njit
except ImportError:  # slow, but the same

    def njit(*args: Any, **_: Any) -> Any:
        """Leave the function as it is."""
        return args[0] if args else (lambda function: function)


PHYSICS_Hz, CONTROL_Hz, SECONDS = 10_000, 500, 8.0
REFRESH = 8  # physics steps for which mass matrix and bias are kept
# Columns of the per-joint parameter table handed to the compiled loop.
NAMES = [
    "J",
    "K",
    "R",
    "L",
    "C",
    "V",
    "Fs",
    "vs",
    "load",
    "asym",
    "cog_A",
    "cog_n",
    "cog_phi",
    "k",
    "d",
    "w",
    "scale",
    "drag",
    "cubic",
    "res",
    "spring",
    "posf",
    "warm",
    "slip",
    "rot_N",
]
AT = {name: k for k, name in enumerate(NAMES)}


@njit(cache=True)
def rnea(q, qd, qdd, dh, com, mass, inertia, g, payload):
    """Joint torques in the base frame; the last row of dh is the fixed forearm that ends at the tip."""
    n = 3
    R = np.eye(3)
    z = np.zeros((n, 3))
    o = np.zeros((n + 1, 3))
    f = np.zeros((n, 3))
    m = np.zeros((n, 3))
    w = np.zeros(3)
    al = np.zeros(3)
    a = -g.copy()
    for i in range(n):
        z[i] = R[:, 2]
        al = al + z[i] * qdd[i] + np.cross(w, z[i]) * qd[i]
        w = w + z[i] * qd[i]
        d, th, ln, ap = dh[i, 0], dh[i, 1] + q[i], dh[i, 2], dh[i, 3]
        c, s, ca, sa = np.cos(th), np.sin(th), np.cos(ap), np.sin(ap)
        A = np.array([[c, -s * ca, s * sa], [s, c * ca, -c * sa], [0.0, sa, ca]])
        r = R @ np.array([ln * c, ln * s, d])
        R = R @ A
        o[i + 1] = o[i] + r
        a = a + np.cross(al, r) + np.cross(w, np.cross(w, r))
        rc = R @ com[i]
        ac = a + np.cross(al, rc) + np.cross(w, np.cross(w, rc))
        F = mass[i] * ac
        In = R @ np.diag(inertia[i]) @ R.T
        N = In @ al + np.cross(w, In @ w)
        f[i] = F
        m[i] = N + np.cross(o[i + 1] + rc, F)
    d, th, ln = dh[3, 0], dh[3, 1], dh[3, 2]
    rt = R @ np.array([ln * np.cos(th), ln * np.sin(th), d])
    at = a + np.cross(al, rt) + np.cross(w, np.cross(w, rt))
    f[n - 1] += payload * at
    m[n - 1] += np.cross(o[n] + rt, payload * at)
    tau = np.zeros(n)
    Fs = np.zeros(3)
    Ms = np.zeros(3)
    for i in range(n - 1, -1, -1):
        Fs = Fs + f[i]
        Ms = Ms + m[i]
        tau[i] = np.dot(z[i], Ms - np.cross(o[i], Fs))
    return tau, o[n] + rt


@njit(cache=True)
def simulate(sets, ff, p, dh, com, mass, inertia, g, payload, delay, sag, noise_seed, supply, limit, gains):
    """One run: (samples, 3) set-points to encoder angles, currents, voltages, tips."""
    np.random.seed(noise_seed)
    ns = sets.shape[0]
    sub = PHYSICS_Hz // CONTROL_Hz
    h = 1.0 / PHYSICS_Hz
    q = sets[0].copy()
    qd = np.zeros(3)
    th = q.copy()
    thd = np.zeros(3)
    cur = np.zeros(3)
    zf = np.zeros(3)
    out_q = np.zeros((ns, 3))
    out_i = np.zeros((ns, 3))
    out_u = np.zeros((ns, 3))
    out_x = np.zeros((ns, 3))
    counts = 2.0 * np.pi / (2048.0 * p[:, 24])
    nd = round(delay * PHYSICS_Hz)
    queue = np.zeros((nd + 1, 3))
    M = np.zeros((3, 3))
    bias = np.zeros(3)
    trans = np.zeros(3)
    grav, _ = rnea(q, qd, qd, dh, com, mass, inertia, g, payload)
    for j in range(3):
        trans[j] = grav[j]
        if p[j, 13] > 0:
            q[j] = th[j] - grav[j] / p[j, 13]
        if p[j, 15] > 0:
            q[j] = th[j] - np.sign(grav[j]) * p[j, 15] / 2 - grav[j] / 2e4
        cur[j] = grav[j] / (p[j, 1] * (1 + p[j, 16]))
    prev = th.copy()
    integ = np.zeros(3)
    last = np.zeros(3)
    u = cur * p[:, 2]
    queue[:] = u
    count = 0
    slipped = np.zeros(3)
    for s in range(ns):
        if s == ns // 2:
            for j in range(3):
                slipped[j] = p[j, 23]
        enc = np.round(th / counts) * counts
        out_q[s] = enc
        out_i[s] = cur + np.random.normal(0.0, 0.01, 3)
        _, tip = rnea(q + slipped, qd, qd, dh, com, mass, inertia, g, 0.0)
        out_x[s] = tip + np.random.normal(0.0, 0.00014, 3)
        e = sets[s] - enc
        v = (enc - prev) * CONTROL_Hz
        prev = enc.copy()
        vs = (sets[min(s + 1, ns - 1)] - sets[s]) * CONTROL_Hz
        integ += e / CONTROL_Hz
        for j in range(3):
            u[j] = ff[s, j] + gains[0] * e[j] + gains[1] * (vs[j] - v[j]) + gains[2] * integ[j]
            lo = p[j, 1] * v[j] - limit * p[j, 2]
            hi = p[j, 1] * v[j] + limit * p[j, 2]
            u[j] = min(max(min(max(u[j], lo), hi), -supply), supply)
        out_u[s] = u
        for _ in range(sub):
            queue[count % (nd + 1)] = u
            ua = queue[(count + 1) % (nd + 1)]
            if count % REFRESH == 0:
                zero = np.zeros(3)
                bias, _t = rnea(q, qd, zero, dh, com, mass, inertia, g, payload)
                for k in range(3):
                    unit = np.zeros(3)
                    unit[k] = 1.0
                    col, _t = rnea(q, zero, unit, dh, com, mass, inertia, np.zeros(3), payload)
                    M[:, k] = col
            count += 1
            total = 0.0
            for j in range(3):
                total += ua[j] / supply * cur[j]
            A = M.copy()
            rhs = -bias
            mot = np.zeros(3)
            for j in range(3):
                K = p[j, 1] * (1 + p[j, 16])
                volt = ua[j] * (1.0 - sag * total / supply)
                Rj = p[j, 2] * (1 + p[j, 19])
                target = (volt - K * (thd[j] + 0.5 * h * last[j])) / Rj
                cur[j] = target + (cur[j] - target) * np.exp(-h * Rj / p[j, 3])
                vel = thd[j]
                sg = 1.0 if vel >= 0 else -1.0
                gl = (
                    p[j, 4]
                    + p[j, 9] * sg
                    + p[j, 8] * abs(trans[j])
                    + p[j, 6] * np.exp(-((vel / p[j, 7]) ** 2))
                )
                gl += p[j, 21] * np.sin(2 * th[j]) ** 2 + p[j, 22] * s / ns
                gl = max(gl, 1e-3)
                s0 = 15000.0
                zold = zf[j]
                zf[j] = (zold + h * vel) / (1 + h * s0 * abs(vel) / gl)
                fr = s0 * zf[j] + 2.0 * (zf[j] - zold) / h * np.exp(-((vel / 0.005) ** 2)) + p[j, 5] * vel
                fr += p[j, 17] * vel * abs(vel) + p[j, 18] * vel**3 + p[j, 20] * th[j]
                cog = p[j, 10] * np.sin(p[j, 11] * p[j, 24] * th[j] + p[j, 12])
                mot[j] = K * cur[j] - fr - cog
                if p[j, 13] > 0 or p[j, 15] > 0:
                    gap = th[j] - q[j]
                    rate = thd[j] - qd[j]
                    if p[j, 13] > 0:
                        tr = p[j, 13] * gap + p[j, 14] * rate
                    else:
                        half = p[j, 15] / 2
                        tr = 0.0
                        if gap > half:
                            tr = max(2e4 * (gap - half) + 12.0 * rate, 0.0)
                        elif gap < -half:
                            tr = min(2e4 * (gap + half) + 12.0 * rate, 0.0)
                    trans[j] = tr
                    rhs[j] += tr
                else:
                    A[j, j] += p[j, 0]
                    rhs[j] += mot[j]
            qdd = np.linalg.solve(A, rhs)
            for j in range(3):
                last[j] = qdd[j]
                if p[j, 13] > 0 or p[j, 15] > 0:
                    last[j] = (mot[j] - trans[j]) / p[j, 0]
            for j in range(3):
                qd[j] += h * qdd[j]
                q[j] += h * qd[j]
                if p[j, 13] > 0 or p[j, 15] > 0:
                    thd[j] += h * (mot[j] - trans[j]) / p[j, 0]
                    th[j] += h * thd[j]
                else:
                    trans[j] = mot[j] - p[j, 0] * qdd[j]
                    thd[j] = qd[j]
                    th[j] = q[j]
    return out_q, out_i, out_u, out_x


def set_points(rng: np.random.Generator) -> list[tuple[np.ndarray, float]]:
    """Eleven runs: slow, very slow, free, sweep, small and fast, ramps; three repeats of one kind or another."""
    t = np.arange(int(SECONDS * CONTROL_Hz)) / CONTROL_Hz
    ease = np.clip(t / 1.0, 0, 1)
    ease = ease**3 * (10 - 15 * ease + 6 * ease**2)
    middle = np.array([0.0, -0.6, 0.1])

    def waves(amplitude: float, low: float, high: float, count: int) -> np.ndarray:
        out = np.zeros((len(t), 3))
        for j in range(3):
            for f in rng.uniform(low, high, count):
                out[:, j] += np.sin(2 * np.pi * f * t + rng.uniform(0, 2 * np.pi)) / count
        out -= out[0]
        return middle + amplitude * out * ease[:, None]

    def ramps() -> np.ndarray:
        out = np.zeros((len(t), 3))
        for j in range(3):
            period = 4.0
            s = (t % period) / (period / 2)
            tri = np.where(s < 1, s, 2 - s)
            x = np.clip(tri, 0, 1)
            out[:, j] = x**3 * (10 - 15 * x + 6 * x**2)
        return middle + out * np.array([0.6, -0.9, 0.9]) + np.array([0.0, 0.3, -0.3])

    phase = 2 * np.pi * (0.2 * t + 0.5 * (2.6 - 0.2) / SECONDS * t**2)
    sweep = middle + 0.12 * np.sin(phase)[:, None] * ease[:, None] * np.array([1.0, 0.8, 1.0])
    slow = (
        middle
        + np.stack([0.24 * np.sin(0.8 * t), 0.35 * (np.cos(1.1 * t) - 1), 0.5 * np.sin(1.9 * t)], 1)
        * ease[:, None]
    )
    creep = middle + 0.055 * np.stack([np.sin(1.2 * t), np.sin(1.0 * t), np.sin(1.4 * t)], 1) * ease[:, None]
    free, other, third = waves(0.75, 0.1, 0.7, 4), waves(0.75, 0.1, 0.7, 4), waves(0.75, 0.1, 0.7, 4)
    fast = waves(0.03, 2.0, 7.0, 5)
    up = ramps()
    runs = [slow, creep, free, sweep, fast, up, other, slow, third, up, free]
    return [(run, 0.5 if k in (6, 9) else 0.0) for k, run in enumerate(runs)]


def table(arm: dict[str, Any]) -> np.ndarray:
    """Nominal parameters of the three joints."""
    p = np.zeros((3, len(NAMES)))
    for drive in arm["drive"]:
        j, ratio = drive["joint"] - 1, drive["gear_ratio"]
        p[j, AT["J"]] = ratio**2 * drive["rotor_inertia_kg_m2"]
        p[j, AT["K"]] = ratio * drive["torque_constant_Nm_A"]
        p[j, AT["R"]], p[j, AT["L"]], p[j, AT["rot_N"]] = (
            drive["resistance_ohm"],
            drive["inductance_H"],
            ratio,
        )
        p[j, AT["vs"]] = 0.05
    return p


def hide(
    rng: np.random.Generator, effect: str, joint: int, p: np.ndarray, hidden: dict[str, Any]
) -> dict[str, Any]:
    """Put one effect into the tables; its entry for truth.json."""
    j = joint - 1
    span = rng.uniform
    sign = rng.choice([-1.0, 1.0])
    entry: dict[str, float]
    match effect:
        case "coulomb_friction":
            p[j, AT["C"]] += (x := span(0.15, 0.8))
            entry = {"torque_Nm": x}
        case "viscous_friction":
            p[j, AT["V"]] += (x := span(0.2, 1.2))
            entry = {"coefficient_Nm_s_rad": x}
        case "stribeck_friction":
            p[j, AT["Fs"]], p[j, AT["vs"]] = (x := span(0.4, 1.5)), (y := span(0.025, 0.09))
            entry = {"torque_Nm": x, "speed_rad_s": y}
        case "load_friction":
            p[j, AT["load"]] = (x := span(0.06, 0.3))
            entry = {"fraction": x}
        case "asymmetric_friction":
            p[j, AT["asym"]] = (x := sign * span(0.1, 0.4))
            entry = {"torque_Nm": x}
        case "cogging":
            p[j, 10], p[j, 11], p[j, 12] = (
                (x := span(0.2, 1.2)),
                (y := float(rng.integers(4, 15))),
                (z := span(-3, 3)),
            )
            entry = {"amplitude_Nm": x, "order": y, "phase_rad": z}
        case "torque_constant":
            p[j, AT["scale"]] = (x := sign * span(0.04, 0.15))
            entry = {"scale": 1 + x}
        case "command_delay":
            hidden["delay"] = (x := span(0.0008, 0.004))
            entry = {"delay_s": x}
        case "supply_sag":
            hidden["sag"] = (x := span(0.05, 0.4))
            entry = {"resistance_ohm": x}
        case "payload":
            hidden["payload"] = (x := span(0.05, 0.3))
            entry = {"mass_kg": x}
        case "link_inertia":
            key = str(rng.choice(["mass_kg", "inertia_kg_m2"]))
            x = span(0.1, 0.4) if key == "mass_kg" else span(0.01, 0.04)
            hidden[key] = (j, x)
            entry = {key: x}
        case "joint_compliance":
            p[j, AT["k"]], p[j, AT["d"]] = (x := span(150.0, 900.0)), span(0.4, 1.5)
            entry = {"stiffness_Nm_rad": x}
        case "backlash":
            p[j, AT["w"]] = (x := span(0.004, 0.02))
            entry = {"width_rad": x}
        case "drag":
            p[j, AT["drag"]] = (x := span(0.4, 2.5))
            entry = {"coefficient": x}
        case "cubic":
            p[j, AT["cubic"]] = (x := span(0.3, 1.5))
            entry = {"coefficient": x}
        case "resistance":
            p[j, AT["res"]] = (x := span(0.1, 0.4))
            entry = {"share": x}
        case "spring":
            p[j, AT["spring"]] = (x := span(0.5, 2.0))
            entry = {"stiffness": x}
        case "position_friction":
            p[j, AT["posf"]] = (x := span(0.3, 1.0))
            entry = {"torque": x}
        case "warming":
            p[j, AT["warm"]] = (x := span(0.2, 0.8))
            entry = {"torque": x}
        case "slip":
            p[j, AT["slip"]] = (x := span(0.003, 0.01))
            entry = {"angle": x}
        case _:
            raise SystemExit(f"unknown effect {effect}")
    return {"effect": effect, "joint": joint, "parameters": entry}


def main(arm_path: Path, out: Path, seed: int, effects: str, joint: int | None) -> None:
    """Write one case."""
    rng = np.random.default_rng(seed)
    arm = tomllib.loads(arm_path.read_text())
    text = arm_path.read_text().split("[[effect]]")[0]
    p = table(arm)
    for j in range(3):
        p[j, AT["C"]], p[j, AT["V"]] = rng.uniform(0.4, 0.9), rng.uniform(0.3, 0.9)
        for effect, key, value in (
            ("coulomb_friction", "torque_Nm", p[j, AT["C"]]),
            ("viscous_friction", "coefficient_Nm_s_rad", p[j, AT["V"]]),
        ):
            text += f'[[effect]]\neffect = "{effect}"\njoint = {j + 1}\nparameters = {{ {key} = {value:.6f} }}\n\n'
    nominal = p.copy()
    hidden: dict[str, Any] = {"delay": 0.0, "sag": 0.0, "payload": 0.0}
    truth = [
        hide(rng, effect, joint or int(rng.integers(1, 4)), p, hidden)
        for effect in effects.split("+")
        if effect != "none"
    ]
    links = arm["link"]
    dh = np.array([[k["d_m"], k["theta_rad"], k["L_m"], k["alpha_rad"]] for k in links])
    com = np.array([k.get("com_m", [0, 0, 0]) for k in links[:3]], dtype=float)
    mass = np.array([k["mass_kg"] for k in links[:3]])
    inertia = np.array([k["inertia_kg_m2"] for k in links[:3]])
    nominal_mass, nominal_inertia = mass.copy(), inertia.copy()
    if "mass_kg" in hidden:
        mass[hidden["mass_kg"][0]] += hidden["mass_kg"][1]
    if "inertia_kg_m2" in hidden:
        inertia[hidden["inertia_kg_m2"][0]] += hidden["inertia_kg_m2"][1]
    g = np.array(arm["gravity_m_s2"])
    lines = [
        "run,t_s,payload_kg,"
        + ",".join(f"q{j}_set_rad" for j in (1, 2, 3))
        + ","
        + ",".join(f"{a}{j}_{b}" for a, b in (("q", "rad"), ("i", "A"), ("u", "V")) for j in (1, 2, 3))
        + ",x_m,y_m,z_m"
    ]
    for k, (sets, load) in enumerate(set_points(rng)):
        v = np.gradient(sets, 1 / CONTROL_Hz, axis=0)
        a = np.gradient(v, 1 / CONTROL_Hz, axis=0)
        ff = np.zeros_like(sets)
        for s in range(len(sets)):
            tau, _ = rnea(sets[s], v[s], a[s], dh, com, nominal_mass, nominal_inertia, g, load)
            fr = nominal[:, AT["C"]] * np.tanh(v[s] / 0.02) + nominal[:, AT["V"]] * v[s]
            i = (tau + nominal[:, AT["J"]] * a[s] + fr) / nominal[:, AT["K"]]
            ff[s] = i * nominal[:, AT["R"]] + nominal[:, AT["K"]] * v[s]
        found = simulate(
            sets,
            ff,
            p,
            dh,
            com,
            mass,
            inertia,
            g,
            load + hidden["payload"],
            hidden["delay"],
            hidden["sag"],
            int(rng.integers(1 << 30)),
            24.0,
            8.0,
            np.array([60.0, 1.2, 100.0]),
        )
        q, i, u, x = found
        for s in range(len(sets)):
            tip = ",".join(f"{c:.6f}" for c in x[s]) if s % 5 == 0 else ",,"
            cells = (
                [f"{c:.6f}" for c in sets[s]]
                + [f"{c:.7f}" for c in q[s]]
                + [f"{c:.4f}" for c in (*i[s], *u[s])]
            )
            lines.append(f"{k + 1},{s / CONTROL_Hz:.3f},{load}," + ",".join(cells) + "," + tip)
    out.mkdir(parents=True, exist_ok=True)
    (out / "arm.toml").write_text(text)
    with gzip.open(out / "log.csv.gz", "wt", compresslevel=3) as file:
        file.write("\n".join(lines) + "\n")
    (out / "truth.json").write_text(json.dumps({"seed": seed, "effects": truth}, indent=1))


if __name__ == "__main__":
    main(
        Path(sys.argv[1]),
        Path(sys.argv[2]),
        int(sys.argv[3]),
        sys.argv[4],
        int(sys.argv[5]) if len(sys.argv) > 5 else None,
    )
