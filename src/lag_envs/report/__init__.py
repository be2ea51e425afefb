"""Error against run time, and stability: what ``lag-envs report`` measures, and how it is shown.

=====================  ====================================================================================
`report`               the whole: settings, jobs, files
`runner`               runs jobs in processes of their own, keeps what is finished
`content`              what a section shows: text, tables, pictures, claims
`page`                 HTML, Markdown, CSV and the README's tables from the measured rows
`oracle`, `formulas`   the exact motion of any scene, from Lagrange's equations by SymPy
`closed_forms`         what checks it, and takes its place where a pendulum goes far
`reference`            exact ends by these, kept for the processes of a report
`integrators`          the integrators that people would otherwise use
`equations`            problems as rivals are given them: any equation, arrays of starts and parameters
`rivals`, `peers`      ours, those integrators, and other libraries, all behind one interface
`work_precision` ...   one module per section: its jobs and what they measure; `..._results`: what it shows
`points`               errors and times of methods, at their settings
`verdicts`             who is faster at which error, from the points of `work_precision`
`diagrams`             those points as pictures
=====================  ====================================================================================

None of this is used by the environments; it needs the extra ``report``.
"""
