"""Figures, one file a family: finished estimates and an `ax` in, the `ax` out.

`style` fixes sizes, letters and the look of every algorithm; `finding` is the README's picture;
`curves` draws training curves, sensitivity and the evolution of the parameters; `scores` return
against cost, performance profiles and probabilities of improvement; `certificate` the energy
function; `scenes` environments, trajectories and animations. Nothing here computes statistics,
trains, or imports torch.
"""
