"""Self-contained HTML pages: the report of adaptations, and the playground of policies.

``build`` joins JavaScript modules, style and data into one file, ``packing`` puts arrays into it,
``report`` and ``playground`` say what is in each page. What a world brings is its ``envs.page.Page``.
"""
