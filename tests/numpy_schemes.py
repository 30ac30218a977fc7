"""RATTLE and generalized-alpha in NumPy, for two unit masses on two unit rods."""

import numpy as np


GRAVITY = np.array([0.0, 9.81, 0.0, 9.81])


def rods(q):
    outer = q[2:] - q[:2]
    return np.array([q[:2] @ q[:2] - 1, outer @ outer - 1])


def rods_gradient(q):
    outer = q[2:] - q[:2]
    zero = np.zeros(2)
    return 2 * np.array([[*q[:2], *zero], [*-outer, *outer]])


def rattle(q, v, h, steps):
    """Two unit masses: moved back onto the rods, then the velocities projected."""
    for _ in range(steps):
        gradient, impulse = rods_gradient(q), np.zeros(2)
        middle = v + h / 2 * GRAVITY
        for _ in range(8):
            new = q + h * (middle - gradient.T @ impulse)
            slope = -h * rods_gradient(new) @ gradient.T
            impulse = impulse - np.linalg.solve(slope, rods(new))
        half = middle - gradient.T @ impulse
        q, ahead = q + h * half, half + h / 2 * GRAVITY
        gradient = rods_gradient(q)
        push = np.linalg.solve(gradient @ gradient.T, gradient @ ahead)
        v = ahead - gradient.T @ push
    return q, v


def generalized_alpha(q, v, a, vdot, h, steps, rho):
    """By the residual of Arnold and Bruls, in `a1` and `lambda`."""
    alpha_m, alpha_f = (2 * rho - 1) / (rho + 1), rho / (rho + 1)
    gamma = 0.5 + alpha_f - alpha_m
    beta = 0.25 * (gamma + 0.5) ** 2
    x = np.array([*a, 0.0, 0.0])
    for _ in range(steps):

        def step(x, q=q, v=v, a=a, vdot=vdot):
            a1 = x[:4]
            vdot1 = ((1 - alpha_m) * a1 + alpha_m * a - alpha_f * vdot) / (1 - alpha_f)
            q1 = q + h * v + h**2 * ((0.5 - beta) * a + beta * a1)
            return q1, v + h * ((1 - gamma) * a + gamma * a1), vdot1

        for _ in range(8):
            q1, _, vdot1 = step(x)
            gradient = rods_gradient(q1)
            residual = np.array([*(vdot1 - GRAVITY + gradient.T @ x[4:]), *rods(q1)])
            jacobian = np.zeros((6, 6))
            stiffness = 2 * np.array([[x[4] + x[5], -x[5]], [-x[5], x[5]]])
            jacobian[:4, :4] = (1 - alpha_m) / (1 - alpha_f) * np.eye(4)
            jacobian[:4, :4] += h**2 * beta * np.kron(stiffness, np.eye(2))
            jacobian[:4, 4:] = gradient.T
            jacobian[4:, :4] = h**2 * beta * gradient
            x = x - np.linalg.solve(jacobian, residual)
        (q, v, vdot), a = step(x), x[:4]
    return q, v
