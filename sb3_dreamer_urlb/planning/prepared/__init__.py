"""The planned agent in the forms that are fast on a CPU: who calls whom.

A planner (``planning/dyna_mpc.py``) knows no form. It asks a :class:`~sb3_dreamer_urlb.planning.PlannableModel` for the verbs
``step``, ``imagine``, ``rewards``, ``values``, ``discounts`` and ``act``, and :func:`agent.planned` makes it one, once a plan.
The choice among the forms is made there and nowhere else::

    DreamerPolicy.choose
      ├─ native.using(compile, device)           says for this thread whether kernels of our own are wanted and to be had
      └─ planned(agent, skill)                   on which device are the networks? are those kernels fast here?
           ├─ PlannedAgent   (agent.py)          CUDA: the networks themselves, in a graph (learning/graphs.py)
           ├─ PreparedAgent  (prepared/agent.py) CPU: states as the places of their ones, weights laid out once a plan
           │    └─ parts.py: Dynamics, Head      torch's operators
           │         └─ prepacked.py             one dense layer
           └─ NativeAgent    (prepared/agent.py) the same on kernels of our own, where the processor has AVX-512
                └─ native_parts.py: NativeDynamics, NativeHead
                     ├─ native/planner_ops.py    sums of rows, gates, draws
                     ├─ chain.py                 dense layers in a row: on tiles (AMX) in one pass, else prepacked.py
                     └─ native/rollout_ops.py    with tiles, ``imagine`` is one kernel for all H steps

All three give the same plan up to rounding and to the order of their draws (``tests/planning/``).

Layers that serve updates, too (``nn/dense.py``, ``nn/activation.py``, ``nn/distributions.py``, ``world_model/convolution.py``,
``world_model/gru.py``, ``spaces/observations.py``), ask ``native.active()`` or ``native.on_lanes()`` themselves. The answer is
that of the ``native.using`` around them, which only the policy and the learner write.
"""
