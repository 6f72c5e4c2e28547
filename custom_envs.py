"""rl_zoo3 imports a module of this name from the working directory, so that ``python -m rl_zoo3.train`` knows us here."""

from sb3_dreamer_urlb.zoo.registration import register

register()
