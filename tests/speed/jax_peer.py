"""JAX's sides, for the interpreter of the peers' environment: `python -m tests.speed.jax_peer NAME key=value`.

Plain versions of TD3+BC and CQL with the arithmetic of algos/, compiled as one program for many updates. They share
no code with offbench and exist to be timed.
"""

from __future__ import annotations

import itertools
import os
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

from tests.speed.side import Work, serve

# XLA would use every core. Set before JAX is imported.
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"

import jax
import jax.numpy as jnp
import optax

BATCH, OBSERVATIONS, ACTIONS, ROWS = 256, 11, 3, 100_000
HIDDEN = (256, 256)
DISCOUNT, TAU = 0.99, 0.005
Parameters = list[tuple[jax.Array, jax.Array]]
State = dict[str, Any]


def network(key: jax.Array, *sizes: int) -> Parameters:
    """Return weights [in, out] and biases [out], uniform within 1 / sqrt(in)."""
    layers = []
    for i, o in itertools.pairwise(sizes):
        key, weights, biases = jax.random.split(key, 3)
        bound = i**-0.5
        layers.append(
            (
                jax.random.uniform(weights, (i, o), minval=-bound, maxval=bound),
                jax.random.uniform(biases, (o,), minval=-bound, maxval=bound),
            )
        )
    return layers


def outputs(layers: Parameters, x: jax.Array) -> jax.Array:
    """Return a perceptron's outputs; relu between layers."""
    *hidden, (weight, bias) = layers
    for w, b in hidden:
        x = jax.nn.relu(x @ w + b)
    return x @ weight + bias


def q_values(critics: list[Parameters], observations: jax.Array, actions: jax.Array) -> jax.Array:
    """Return each critic's Q [critics, ...]."""
    x = jnp.concatenate([observations, actions], -1)
    return jnp.stack([outputs(critic, x)[..., 0] for critic in critics])


def polyak(target: Any, source: Any) -> Any:
    """Return target moved by TAU towards source."""
    return jax.tree.map(lambda t, s: t + TAU * (s - t), target, source)


def descend(adam: optax.GradientTransformation, gradients: Any, state: Any, parameters: Any) -> tuple[Any, Any]:
    """Return the parameters and Adam's state after a step."""
    updates, state = adam.update(gradients, state, parameters)
    return optax.apply_updates(parameters, updates), state


def dataset(key: jax.Array) -> dict[str, jax.Array]:
    """Return random transitions."""
    a, b, c, d = jax.random.split(key, 4)
    return {
        "observations": jax.random.normal(a, (ROWS, OBSERVATIONS)),
        "next_observations": jax.random.normal(b, (ROWS, OBSERVATIONS)),
        "actions": jax.random.uniform(c, (ROWS, ACTIONS), minval=-1, maxval=1),
        "rewards": jax.random.normal(d, (ROWS,)),
        "masks": jnp.ones(ROWS),
    }


def batch_of(data: dict[str, jax.Array], key: jax.Array) -> dict[str, jax.Array]:
    """Return BATCH transitions, drawn with replacement."""
    rows = jax.random.randint(key, (BATCH,), 0, ROWS)
    return {name: values[rows] for name, values in data.items()}


def initial(key: jax.Array, actor_outputs: int) -> State:
    """Return an actor, two critics and their targets."""
    first, *others = jax.random.split(key, 3)
    actor = network(first, OBSERVATIONS, *HIDDEN, actor_outputs)
    critics = [network(other, OBSERVATIONS + ACTIONS, *HIDDEN, 1) for other in others]
    return {"actor": actor, "critics": critics, "actor_target": actor, "critic_targets": critics}


def td3_bc(key: jax.Array) -> tuple[State, Callable[[State, Any, jax.Array], State], int]:
    """Return the state, what a step of it does, and how many updates a step has: two, the second with the actor."""
    adam = optax.adam(3e-4)
    state = initial(key, ACTIONS)
    state |= {"actor_adam": adam.init(state["actor"]), "critic_adam": adam.init(state["critics"])}

    def update_critics(state: State, batch: Any, key: jax.Array) -> State:
        noise = jnp.clip(0.2 * jax.random.normal(key, (BATCH, ACTIONS)), -0.5, 0.5)
        following = jnp.tanh(outputs(state["actor_target"], batch["next_observations"])) + noise
        next_q = q_values(state["critic_targets"], batch["next_observations"], jnp.clip(following, -1, 1)).min(0)
        target = batch["rewards"] + DISCOUNT * batch["masks"] * next_q

        def loss(critics: Any) -> jax.Array:
            return jnp.square(q_values(critics, batch["observations"], batch["actions"]) - target).mean(-1).sum()

        gradients = jax.grad(loss)(state["critics"])
        critics, moments = descend(adam, gradients, state["critic_adam"], state["critics"])
        return state | {"critics": critics, "critic_adam": moments}

    def update_actor(state: State, batch: Any) -> State:
        def loss(actor: Any) -> jax.Array:
            pi = jnp.tanh(outputs(actor, batch["observations"]))
            q = q_values(state["critics"][:1], batch["observations"], pi)[0]
            weight = 2.5 / jax.lax.stop_gradient(jnp.abs(q).mean())
            return -weight * q.mean() + jnp.square(pi - batch["actions"]).mean()

        gradients = jax.grad(loss)(state["actor"])
        actor, moments = descend(adam, gradients, state["actor_adam"], state["actor"])
        return state | {
            "actor": actor,
            "actor_adam": moments,
            "actor_target": polyak(state["actor_target"], actor),
            "critic_targets": polyak(state["critic_targets"], state["critics"]),
        }

    def step(state: State, data: Any, key: jax.Array) -> State:
        one, other, noise, more = jax.random.split(key, 4)
        state = update_critics(state, batch_of(data, one), noise)
        batch = batch_of(data, other)
        return update_actor(update_critics(state, batch, more), batch)

    return state, step, 2


def cql(key: jax.Array, actions: int = 10) -> tuple[State, Callable[[State, Any, jax.Array], State], int]:
    """As `td3_bc`: CQL(H) with importance weights, no Lagrange multiplier, after the cloning updates."""
    actor_adam, critic_adam = optax.adam(3e-5), optax.adam(3e-4)
    state = initial(key, 2 * ACTIONS)
    state |= {
        "log_temperature": jnp.zeros(()),
        "actor_adam": actor_adam.init(state["actor"]),
        "critic_adam": critic_adam.init(state["critics"]),
        "temperature_adam": actor_adam.init(jnp.zeros(())),
    }

    def sampled(actor: Any, observations: jax.Array, key: jax.Array, n: int) -> tuple[jax.Array, jax.Array]:
        mean, log_std = jnp.split(outputs(actor, observations), 2, -1)
        log_std = jnp.clip(log_std, -20, 2)
        noise = jax.random.normal(key, (n, *mean.shape))
        u = mean + jnp.exp(log_std) * noise
        normal = -0.5 * jnp.square(noise) - log_std - 0.5 * jnp.log(2 * jnp.pi)
        return jnp.tanh(u), (normal - 2 * (jnp.log(2.0) - u - jax.nn.softplus(-2 * u))).sum(-1)

    def step(state: State, data: Any, key: jax.Array) -> State:
        rows, *keys = jax.random.split(key, 6)
        batch = batch_of(data, rows)
        now, following = batch["observations"], batch["next_observations"]
        next_actions, _ = sampled(state["actor"], following, keys[0], 1)
        next_q = q_values(state["critic_targets"], following, next_actions[0]).min(0)
        target = batch["rewards"] + DISCOUNT * batch["masks"] * next_q
        here, here_log = sampled(state["actor"], now, keys[1], actions)
        there, there_log = sampled(state["actor"], following, keys[2], actions)
        uniform = jax.random.uniform(keys[3], here.shape, minval=-1, maxval=1)
        several = jnp.concatenate([uniform, here, there])
        log_density = jnp.concatenate([jnp.full_like(here_log, ACTIONS * jnp.log(0.5)), here_log, there_log])
        repeated = jnp.broadcast_to(now, (3 * actions, *now.shape))

        def critic_loss(critics: Any) -> jax.Array:
            q = q_values(critics, now, batch["actions"])
            weighted = q_values(critics, repeated, several) - log_density
            penalty = (jax.nn.logsumexp(weighted, 1) - q).mean(-1)
            return (jnp.square(q - target).mean(-1) + 10 * penalty).sum()

        gradients = jax.grad(critic_loss)(state["critics"])
        critics, critic_moments = descend(critic_adam, gradients, state["critic_adam"], state["critics"])

        def actor_loss(actor: Any) -> tuple[jax.Array, jax.Array]:
            pi, log_pi = sampled(actor, now, keys[4], 1)
            value = q_values(critics, now, pi[0]).min(0)
            return (jnp.exp(state["log_temperature"]) * log_pi[0] - value).mean(), log_pi.mean()

        gradients, log_pi = jax.grad(actor_loss, has_aux=True)(state["actor"])
        actor, actor_moments = descend(actor_adam, gradients, state["actor_adam"], state["actor"])
        temperature, temperature_moments = descend(
            actor_adam, ACTIONS - log_pi, state["temperature_adam"], state["log_temperature"]
        )
        return state | {
            "actor": actor,
            "critics": critics,
            "critic_targets": polyak(state["critic_targets"], critics),
            "log_temperature": temperature,
            "actor_adam": actor_moments,
            "critic_adam": critic_moments,
            "temperature_adam": temperature_moments,
        }

    return state, step, 1


def update(algorithm: str) -> Work:
    """Updates of one run; a unit is one."""
    key = jax.random.key(0)
    state, step, updates = {"td3_bc": td3_bc, "cql": cql}[algorithm](key)
    data = dataset(key)
    steps = 5 if algorithm == "cql" else 50

    @jax.jit
    def several(state: State, key: jax.Array) -> State:
        return jax.lax.scan(lambda s, k: (step(s, data, k), None), state, jax.random.split(key, steps))[0]

    def work() -> int:
        nonlocal state, key
        key, own = jax.random.split(key)
        state = jax.block_until_ready(several(state, own))
        return steps * updates

    return work


def products(algorithm: str) -> Work:
    """The matrix products of an update and nothing else, each by the fastest library; a unit is one update."""
    import time

    import numpy as np
    import torch

    from tests.speed.arithmetic import ALGORITHMS

    torch.set_num_threads(1)
    multiply = jax.jit(jnp.matmul)
    rng = np.random.default_rng(0)

    def onednn(a: Any, b: Any) -> None:
        for one, other in zip(a, b, strict=True):
            torch.ops.mkldnn._linear_pointwise(one, other, None, "none", [], "")

    def ways(copies: int, m: int, k: int, n: int) -> list[Callable[[], object]]:
        a = rng.standard_normal((copies, m, k), np.float32)
        b = rng.standard_normal((copies, k, n), np.float32)
        out = np.empty((copies, m, n), np.float32)
        ours, theirs = (torch.from_numpy(x) for x in (a, b))
        x, y = jnp.asarray(a), jnp.asarray(b)
        return [
            partial(np.matmul, a, b, out=out),
            partial(torch.bmm, ours, theirs, out=torch.empty(copies, m, n)),
            partial(onednn, ours, theirs.transpose(1, 2).contiguous()),  # the layout it likes best
            lambda: jax.block_until_ready(multiply(x, y)),
        ]

    def seconds(call: Callable[[], object]) -> float:
        found = []
        for _ in range(20):
            began = time.perf_counter()
            call()
            found.append(time.perf_counter() - began)
        return min(found)

    counted: dict[Any, float] = {}
    for often, product in ALGORITHMS[algorithm](OBSERVATIONS, ACTIONS, BATCH, HIDDEN):
        counted[product] = counted.get(product, 0) + often
    calls: list[Callable[[], object]] = []
    for product, often in counted.items():
        calls += [min(ways(*product), key=seconds)] * round(2 * often)  # two updates: some come every second one

    def work() -> int:
        for call in calls:
            call()
        return 2

    return work


if __name__ == "__main__":
    serve({"update": update, "products": products}[sys.argv[1]])
