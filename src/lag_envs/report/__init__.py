"""Error against run time, and stability: what ``lag-envs report`` measures, and how results are shown.

=====================  ====================================================================================
`report`               the whole report: settings, jobs, files
`runner`               runs jobs in separate processes, keeps finished results
`content`              the content of a section: text, tables, pictures, claims
`page`                 a report as HTML and CSV, with its figures, from the measured rows
`oracle`, `formulas`   the exact motion of any scene, from Lagrange's equations by SymPy
`closed_forms`         checks the oracle, and replaces it where a pendulum turns far
`reference`            exact end states from both, shared by a report's processes
`integrators`          the integrators that people would otherwise use
`equations`            problems in the form that rivals take: any equation, arrays of starts and parameters
`rivals`, `peers`      lag_envs, those integrators, and other libraries, all behind one interface
`work_precision` ...   one module per section: its jobs and measurements; `..._results`: their presentation
`points`               errors and times of methods, at their settings
`diagrams`             the same points as pictures
=====================  ====================================================================================

The environments use nothing of this package, which needs the extra ``report``.
"""
