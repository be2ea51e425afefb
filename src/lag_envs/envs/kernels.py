"""The whole step of a batch as C++, for a GPU's compiler or any other.

The text consists of a task's script (`lag_envs.envs.scripted`), printed in C++, and of two kernels around it.
``begin`` starts episodes. ``step`` takes a control step: control, guard, motion in certified substeps,
reward, ending, kick, observation, and the start of the next episode if one is over. Each environment is
computed by one thread, from this environment's numbers only. Without a GPU's compiler the kernels are loops
over the environments.

In double precision, compiled without contraction of products and sums, all bits agree with
`lag_envs.envs.unfused.Unfused`. Single precision uses the functions of C's library, and series that are only
as long as it needs.
"""

from __future__ import annotations

from typing import NamedTuple

from lag_envs.envs.scripted import UnfusedProgram
from lag_envs.stepping import primitives
from lag_envs.stepping.script import CPP, CPP_SINGLE
from lag_envs.tasks.base import Task

#: Flags that keep products and sums apart when all bits matter, for NVRTC and for processors' compilers.
APART = ("--fmad=false", "-ffp-contract=off")

#: Sizes of the array of coefficients up to which a GPU's loops are unrolled, in single and double precision.
#: The coefficients are then in registers. On an H100 this makes steps up to 2.5 times as fast. Larger arrays
#: do not fit: in double precision steps of a triple pendulum would become a fifth slower.
ROOM = {True: 1000, False: 200}

_HEAD = """\
#ifdef __CUDACC__
#define INLINE static __device__ __forceinline__
#define KERNEL extern "C" __global__ void
#define EACH(i, n) \\
  for (long long i = blockIdx.x * (long long)blockDim.x + threadIdx.x; i < n; \\
       i += gridDim.x * (long long)blockDim.x)
#define UNROLL {UNROLL}
#define INF real(__longlong_as_double(0x7ff0000000000000ll))
#define UNDEFINED real(__longlong_as_double(0x7ff8000000000000ll))
#else
#include <math.h>
#define INLINE static inline
#define KERNEL extern "C" void
#define EACH(i, n) for (long long i = 0; i < n; ++i)
#define UNROLL
#define INF real(__builtin_inf())
#define UNDEFINED real(__builtin_nan(""))
#endif
namespace environment {
"""

# Random numbers as in lag_envs/stepping/primitives.py.
_RANDOM = """\
typedef unsigned long long word;
INLINE word mixed(word z) {{
  z = (z ^ (z >> 30)) * {_M1:#x}ull;
  z = (z ^ (z >> 27)) * {_M2:#x}ull;
  return z ^ (z >> 31);
}}
INLINE word episode_key(word key, word episode) {{ return mixed(mixed(key) + episode * {GOLDEN:#x}ull); }}
INLINE real uniform(word key, word step, word index) {{
  const word z = mixed(key + (step * {DRAWS} + index + 1) * {GOLDEN:#x}ull);
  return real(z >> (64 - DIGITS)) / real(1ull << DIGITS);
}}
"""

# Shared by both kernels: `f` holds the rows of one environment; the first KEPT of them are kept.
_KERNELS = """\
INLINE void load(real *f, const real *rows, long long i, long long n) {
  for (int j = 0; j < KEPT; ++j) f[j] = rows[j * n + i];
}
INLINE void save(const real *f, real *rows, long long i, long long n) {
  for (int j = 0; j < KEPT; ++j) rows[j * n + i] = f[j];
}
INLINE void show(const real *f, float *observations, long long i, long long n) {
  for (int j = 0; j < OBSERVED; ++j) observations[j * n + i] = float(f[FIRST_OBSERVED + j]);
}
INLINE void begin_one(real *f, word *ids, long long i, long long n, const real *k) {
  const word key = episode_key(ids[i], ++ids[n + i]);
  real d[STATES + TARGETS + 1];
  for (int j = 0; j < STATES + TARGETS; ++j) d[j] = uniform(key, 0, j);
  start(f, d, k);
}

KERNEL begin(long long n, real *rows, word *ids, int *ages, const real *k, const bool *mask,
             const real *states, const real *targets, float *observations) {
  EACH(i, n) {
    real f[SIZE];
    load(f, rows, i, n);
    if (mask[i]) {
      begin_one(f, ids, i, n, k);
      if (states) {
        for (int j = 0; j < STATES; ++j) f[j] = states[i * STATES + j];
        lift(f, k);
      }
      if (targets)
        for (int j = 0; j < TARGETS; ++j) f[FIRST_TARGET + j] = targets[i * TARGETS + j];
      ages[i] = 0;
      save(f, rows, i, n);
    }
    observe(f, k);
    show(f, observations, i, n);
  }
}

// `last` and `restarted` are null unless the next episode begins in the step that ends one.
KERNEL step(long long n, real *rows, word *ids, int *ages, const real *k, long long limit,
            const real *actions, float *observations, real *rewards, bool *terminated, bool *truncated,
            bool *refused, float *last, bool *restarted) {
  const int choices[ACTIONS + 1] = {CHOICES};
  EACH(i, n) {
    real f[SIZE];
    bool over = ages[i] < 0, ended = false, late = false, wrong = false;
    real reward = 0;
    load(f, rows, i, n);
    if (over) {  // the last step ended the episode: the next one begins, and takes no action
      begin_one(f, ids, i, n, k);
      ages[i] = 0;
      observe(f, k);
    } else {
      real a[ACTIONS + 1];
      for (int j = 0; j < ACTIONS; ++j) {
        a[j] = actions[i * ACTIONS + j];
        wrong = wrong || (choices[j] ? !(a[j] >= 0 && a[j] < choices[j]) : !(a[j] - a[j] == 0));
      }
      if (!wrong) {
        move(f, a, k);
        wrong = f[REFUSED] > 0;
      }
      if (wrong) {  // the state is kept, and the episode cut off
        load(f, rows, i, n);
        late = true;
      } else {
        const int age = ages[i] + 1;
        reward = f[REWARD];
        ended = f[ENDED] > 0;
        late = age >= limit;
        ages[i] = age;
        if (DRAWS) {
          const word key = episode_key(ids[i], ids[n + i]);
          real d[DRAWS + 1];
          for (int j = 0; j < DRAWS; ++j) d[j] = uniform(key, age, j);
          kick(f, d, k);
        }
      }
      observe(f, k);
      if (ended || late) {
        if (last) {
          show(f, last, i, n);
          begin_one(f, ids, i, n, k);
          ages[i] = 0;
          observe(f, k);
        } else {
          ages[i] = -1;
        }
      } else if (last) {
        show(f, last, i, n);
      }
    }
    save(f, rows, i, n);
    show(f, observations, i, n);
    rewards[i] = reward;
    terminated[i] = ended;
    truncated[i] = late;
    refused[i] = wrong;
    if (last) restarted[i] = ended || late;
  }
}
"""


class TaskKernels(NamedTuple):
    """A task's kernels.

    Attributes
    ----------
    source : str
        The text, with the functions ``begin`` and ``step``.
    kept : int
        Number of rows kept for each environment.
    targets, controls : slice
        Which of them are targets and controls; states come first.
    constants : tuple of float
        The functions' argument ``k``.
    """

    source: str
    kept: int
    targets: slice
    controls: slice
    constants: tuple[float, ...]


def kernels_of(task: Task, single: bool = False) -> TaskKernels:
    """Print the step of a batch.

    Parameters
    ----------
    task : Task
        The task, without imperfections.
    single : bool
        Whether to use single precision.

    Raises
    ------
    FormulaError
        For a task with imperfect sensors or actuators, or with hidden parameters.
    """
    program = UnfusedProgram(task, single=single)
    rows, formulas = program.rows, task.formulas
    numbers = {
        "DIGITS": 24 if single else 53,
        "SIZE": program.size,
        "KEPT": rows.u.stop,
        "STATES": program.states,
        "FIRST_TARGET": rows.g.start,
        "TARGETS": formulas.targets,
        "ACTIONS": formulas.actions,
        "DRAWS": formulas.draws,
        "FIRST_OBSERVED": rows.o.start,
        "OBSERVED": rows.o.stop - rows.o.start,
        "REWARD": rows.reward,
        "ENDED": rows.ended,
        "REFUSED": rows.refused,
    }
    choices = ", ".join(map(str, [*(formulas.choices or [0] * formulas.actions), 0]))
    script = program.written("start", "lift", "move", "kick", "observe")
    parts = [
        _HEAD.replace("{UNROLL}", '_Pragma("unroll")' if script.memory <= ROOM[single] else ""),
        *(f"const int {name} = {value};\n" for name, value in numbers.items()),
        script.text(CPP_SINGLE if single else CPP),
        _RANDOM.format(**vars(primitives)),
        _KERNELS.replace("CHOICES", choices),
        "}\n",
    ]
    return TaskKernels("".join(parts), rows.u.stop, rows.g, rows.u, tuple(program.constants))
