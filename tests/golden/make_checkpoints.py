# SPDX-License-Identifier: Apache-2.0
# Makes the checkpoint_*.pth beside it. Ran once with PyTorch 1.13 (python3-torch of Debian 12); the tests read
# the files and need no Python.
import collections

import torch

weights = collections.OrderedDict()
weights['a.weight'] = torch.arange(12, dtype=torch.float32).reshape(3, 4) / 4
weights['a.bias'] = torch.tensor([1.5, -2.0, 3.25], dtype=torch.float16)
weights['bf'] = torch.tensor([[1.0, -0.5], [3.0, 1024.0]], dtype=torch.bfloat16)
weights['count'] = torch.tensor(7, dtype=torch.int64)
base = torch.arange(24, dtype=torch.float32).reshape(4, 6)
weights['transposed'] = base.t()
weights['slice'] = base[1:3, 2:5]
weights['shared'] = base
weights['double'] = torch.tensor([0.1, 0.2], dtype=torch.float64)
weights['mask'] = torch.tensor([True, False, True])
weights['empty'] = torch.zeros(0, 3)
weights['param'] = torch.nn.Parameter(torch.tensor([5.0, 6.0]))
torch.save(weights, 'checkpoint_plain.pth')
torch.save(weights, 'checkpoint_protocol4.pth', pickle_protocol=4)
torch.save(weights, 'checkpoint_legacy.pth', _use_new_zipfile_serialization=False)

net = torch.nn.DataParallel(torch.nn.Sequential(torch.nn.Linear(2, 3), torch.nn.BatchNorm1d(3)))
with torch.no_grad():
    for i, p in enumerate(net.parameters()):
        p.copy_(torch.arange(p.numel(), dtype=torch.float32).reshape(p.shape) + 10 * i)
optimizer = {'state': {0: {'step': 3, 'exp_avg': torch.ones(2)}},
             'param_groups': [{'lr': 1e-3, 'betas': (0.9, 0.999)}]}
torch.save({'epoch': 3, 'best': 0.5, 'history': [1, 2, (3, 4)], 'name': 'x', 'none': None, 'flag': True,
            'model_state_dict': net.state_dict(), 'optimizer': optimizer}, 'checkpoint_nested.pth')
