"""Self-contained HTML pages: the report of adaptations, and the playground of policies.

``build`` joins JavaScript modules, style and data into one file, and ``packing`` encodes arrays for it.
``report`` and ``playground`` prepare the data of each page. What a world contributes is its
``envs.page.Page``.
"""
