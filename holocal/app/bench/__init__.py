"""Run time against error of every stage, in units of a bare FFT pair: what ``holocal bench`` measures.

| file | what |
|---|---|
| `measure` | the unit, ratios to it, the machine |
| `synthesis` | methods, accuracies, scene densities |
| `encoding` | encoders on the panel; image quality as a pixel-averaging camera sees it |
| `propagation` | free space against the Rayleigh-Sommerfeld sum |
| `document` | JSON, Markdown table, plots |
"""
