"""Drive with an exported policy: NumPy and ONNX Runtime, no torch. Usage: python drive_onnx.py AGENT.onnx [EPISODES]"""

import json
import sys

import numpy as np
import onnxruntime

import rapid
from rapid.scenarios import seeing

if len(sys.argv) not in (2, 3):
    raise SystemExit(__doc__)
session = onnxruntime.InferenceSession(sys.argv[1], providers=["CPUExecutionProvider"])
lanes = json.loads(session.get_modelmeta().custom_metadata_map["rapid"])["lanes"]
scenario = {3: "lane-3-density-2", 4: "lane-4-density-2.5", 5: "lane-5-density-3"}[lanes]
env = rapid.make_env(scenario, config=seeing(session.get_inputs()[0].shape[1]))
returns = []
for episode in range(int(sys.argv[2]) if len(sys.argv) > 2 else 5):
    obs, _ = env.reset(seed=episode)
    total, ended, info = 0.0, False, {}
    while not ended:
        (q,) = session.run(["q"], {"obs": obs[None].astype(np.float32)})
        obs, reward, terminated, truncated, info = env.step(int(q[0].argmax()))
        total, ended = total + float(reward), terminated or truncated
    print(f"episode {episode}: return {total:.2f}{', crashed' if info['crashed'] else ''}")
    returns.append(total)
print(f"mean return {np.mean(returns):.2f}; torch was {'used' if 'torch' in sys.modules else 'not needed'}")
