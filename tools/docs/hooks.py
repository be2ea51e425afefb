"""Hooks that MkDocs calls to build the site; they add generated pages, files of the root, and the board."""

from __future__ import annotations

import io
import posixpath
import re
import sys
from collections.abc import Callable
from functools import cache
from html import escape, unescape
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.nav import Link, Navigation
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "src"), str(ROOT)]

#: Files of the checkout that become pages of the site too.
ROOT_FILES = {"CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md", "NOTICE.md": "notice.md"}
SOURCE = "https://github.com/lag-envs/lag-envs/blob/main/"
#: Paths of the leaderboard's page and of the environments' pages.
BOARD, ENVIRONMENTS = "board", "environments"
#: The section of the board's page, and the guide to submissions, which is part of another section's page.
SECTION, SUBMIT = "Leaderboard", ("How to submit", "contributing.html#submit-to-the-leaderboard")
MOVING = "images/moving"
#: The longest description of a page.
LONGEST = 200


@cache
def board() -> dict[str, Any]:
    """Return the data of the leaderboard's page."""
    from lag_envs.leaderboard.board import Board
    from lag_envs.leaderboard.standings import page_data

    return page_data(Board(ROOT / "leaderboard"))


@cache
def generated() -> dict[str, str]:
    """Return the generated pages, by their path in the site."""
    from tools.docs import environments, scenes

    found = {
        f"{ENVIRONMENTS}/{env_id}.md": text for env_id, text in environments.pages(board(), ROOT).items()
    }
    found[f"{ENVIRONMENTS}/index.md"] = environments.index()
    found["scenes.md"] = scenes.scenes_page()
    return found


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """List the environments in the navigation."""
    from lag_envs.tasks import TASKS

    for entry in config.nav or ():
        if "Environments" in entry:
            entry["Environments"] += [{env_id: f"{ENVIRONMENTS}/{env_id}.md"} for env_id in TASKS]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages, and pages from the root."""
    from lag_envs.leaderboard.site.build import STATIC
    from tools.docs.font import FILE, math_font

    texts = generated() | {
        place: (ROOT / name).read_text(encoding="utf-8") for name, place in ROOT_FILES.items()
    }
    shared = {f"assets/{name}": (STATIC / name).read_bytes() for name in ("look.css", "logo.svg")}
    for place, content in (texts | board_pages(config) | stills() | shared | {FILE: math_font()}).items():
        files.append(File.generated(config, place, content=content))
    return files


def board_pages(config: MkDocsConfig) -> dict[str, str | bytes]:
    """Return the files of the board's page, whose head has the site's sections and those of its own."""
    from lag_envs.leaderboard.site.build import render

    sections, section = [], []
    for entry in config.nav or ():
        ((title, listed),) = entry.items()
        links = [next(iter(page.items())) if isinstance(page, dict) else (title, page) for page in listed]
        if title == SECTION:
            links = section = [("Board", f"{BOARD}/index.html"), *links, SUBMIT]
        sections.append((title, links[0][1]))

    def addresses(links: list[tuple[str, str]]) -> list[tuple[str, str]]:
        return [(title, posixpath.relpath(place.replace(".md", ".html"), BOARD)) for title, place in links]

    pages, files = render(
        board(),
        f"{config.site_url}{BOARD}/",
        addresses(sections),
        addresses(section),
        SOURCE,
        f"../{ENVIRONMENTS}/",
    )
    return {f"{BOARD}/{name}": content for name, content in (pages | files).items()}


def stills() -> dict[str, str | bytes]:
    """Return a frame from the middle of each moving picture, for readers who do not want motion."""
    from PIL import Image

    found: dict[str, str | bytes] = {}
    for path in sorted((ROOT / "docs" / MOVING).glob("*.webp")):
        with Image.open(path) as picture:
            picture.seek(picture.n_frames // 2)
            picture.save(kept := io.BytesIO(), "WEBP", quality=80)
        found[f"{MOVING}/{path.stem}-still.webp"] = kept.getvalue()
    return found


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Add stills to moving pictures (docs/assets/docs.js adds a button); write formulas and minus signs.

    Short cells of tables are kept on a line. Other pictures become links to their files, which can be
    enlarged.
    """
    html = re.sub(
        rf'<p>(<img [^>]*src="((?:(?!{MOVING})[^"])+)"[^>]*>)</p>',
        r'<p class="figure"><a href="\2">\1</a></p>',
        html,
    )
    html = re.sub(
        rf'<img [^>]*src="([^"]*{MOVING}/[^"]+)\.webp"[^>]*>',
        r'<span class="moving"><picture><source media="(prefers-reduced-motion: reduce)" '
        r'srcset="\1-still.webp">\g<0></picture></span>',
        html,
    )
    # Numbers such as 1e-16 are not broken at their hyphens.
    html = re.sub(r"<td>(?=[^<]{1,10}</td>)", '<td class="short">', html)
    html = html.replace("::</p>", ":</p>")  # docstrings announce code by two colons
    html = _changed(html, lambda text: re.sub(r"(?<=\[\d\])_|^\.\. (?=\[\d\])", "", text))  # and write [1]_
    return with_minus(with_formulas(with_lazy_pictures(html)))


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Fill in formulas and the scenes' names, and redirect links out of the folder docs to site or source."""
    from lag_envs.scenes import SCENES
    from tools.docs.equations import formula_mathml

    markdown = re.sub(
        r"^\$\$\n(.+?)\n\$\$$", lambda found: formula_mathml(found[1]), markdown, flags=re.MULTILINE
    )
    names = ", ".join(sorted(kind.__name__ for kind in SCENES))
    markdown = markdown.replace("members: SCENES\n", f"members: [{names}]\n")
    about = config.extra["descriptions"].get(page.file.src_uri) or description(page, markdown)
    page.meta.setdefault("description", escape(about))  # the theme does not escape it
    at_root = {place: name for name, place in ROOT_FILES.items()}
    here = at_root.get(page.file.src_uri, f"docs/{page.file.src_uri}")

    def link(found: re.Match) -> str:
        target, mark, anchor = found[1].partition("#")
        if re.match(r"[a-z]+:", target) or not target:
            return found[0]
        place = posixpath.normpath(posixpath.join(posixpath.dirname(here), target))
        if (place, anchor) == ("README.md", ENVIRONMENTS):
            place, mark, anchor = f"{ENVIRONMENTS}/index.md", "", ""
        elif place in ROOT_FILES:
            place = ROOT_FILES[place]
        elif place.startswith("docs/"):
            place = place.removeprefix("docs/")
        elif (ROOT / place).exists():
            return f"]({SOURCE}{place}{mark}{anchor})"
        back = posixpath.relpath(place, posixpath.dirname(page.file.src_uri) or ".")
        return f"]({back}{mark}{anchor})"

    return re.sub(r"\]\(([^)\s]+)\)", link, markdown)


def with_lazy_pictures(html: str) -> str:
    """Return HTML whose pictures are loaded when they come near, except the first, which may be in view."""
    first, image, rest = html.partition("<img ")
    return first + image + rest.replace("<img ", '<img loading="lazy" ')


def with_minus(html: str) -> str:
    """Return HTML with minus signs in place of hyphens before numbers, except in code and tags.

    Examples
    --------
    >>> with_minus("<td>-1266.5, 1e-6, 2026-11-26 <code>-1</code></td>")
    '<td>−1266.5, 1e-6, 2026-11-26 <code>-1</code></td>'
    """
    return _changed(html, lambda text: re.sub(r"(?<![\w.-])-(?=[\d∞])", "−", text))


def with_formulas(html: str) -> str:
    """Return HTML with the formulas in its text, LaTeX between dollar signs, as MathML.

    Examples
    --------
    >>> with_formulas("<p>so $x = 1$, <code>$x = 1$</code></p>").count("<math")
    1
    """
    from tools.docs.equations import formula_mathml

    return _changed(
        html, lambda text: re.sub(r"\$([^$]+)\$", lambda f: formula_mathml(unescape(f[1]), block=False), text)
    )


def _changed(html: str, change: Callable[[str], str]) -> str:
    """Return HTML whose texts are changed, except in code."""
    parts = re.split(r"(<(code|annotation)\b.*?</\2>|<[^>]*>)", html, flags=re.DOTALL)
    # The texts; after each text come two groups: code or a tag, and the name in it.
    parts[::3] = [change(text) for text in parts[::3]]
    return "".join(text for i, text in enumerate(parts) if i % 3 != 2 and text)


def description(page: Page, markdown: str) -> str:
    """Return a page's description: an environment's first line, or the first sentences of the text."""
    from lag_envs.tasks import TASKS

    if page.title in TASKS:
        return (TASKS[page.title].__doc__ or "").partition("\n")[0]
    markdown = re.sub(r"^```.*?^```", "", markdown, flags=re.DOTALL | re.MULTILINE)
    texts = [part for part in re.split(r"\n\s*\n", markdown) if re.match(r"[A-Z*`\[]", part)]
    if not texts:
        return f"API reference of lag_envs: {page.title}"
    plain = re.sub(
        r"\[([^\]]*)\]\([^)]*\)|[*`]", lambda found: found[1] or "", " ".join(" ".join(texts).split())
    )
    if len(plain) <= LONGEST:
        return plain
    whole = plain[:LONGEST].rpartition(". ")[0]
    return f"{whole}." if whole else f"{plain[:LONGEST].rpartition(' ')[0]} ..."


def on_nav(nav: Navigation, config: MkDocsConfig, files: Files) -> Navigation:
    """Add the board, which is built separately from the pages, and the guide to it."""
    for section in nav.items:
        if section.title == SECTION and section.children is not None:
            section.children.insert(0, Link("Board", f"{BOARD}/index.html"))
            section.children.append(Link(*SUBMIT))
    return nav


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """Add what link previews show, and a name for the search."""
    return with_search_name(output.replace("</head>", f"{preview(page, config)}</head>", 1))


def on_post_template(output_content: str, template_name: str, config: MkDocsConfig) -> str:
    """Complete the pages and lists that are not in the navigation."""
    if template_name == "sitemap.xml":
        from lag_envs.tasks import TASKS

        added = "".join(
            f"  <url><loc>{config.site_url}{BOARD}/{name}.html</loc></url>\n" for name in ("index", *TASKS)
        )
        return output_content.replace("</urlset>", f"{added}</urlset>")
    if template_name == "404.html":
        told = (
            f'<p>This page does not exist, or has moved. <a href="{config.site_url}">To the home page</a></p>'
        )
        output_content = output_content.replace("</h1>", f"</h1>\n{told}", 1)
        output_content = output_content.replace("<title>", "<title>Page not found - ", 1)
    return with_search_name(output_content)


def with_search_name(html: str) -> str:
    """Return a page whose search has a name for screen readers, which the theme omits."""
    search = 'data-md-component="search" role="dialog"'
    return html.replace(search, f'{search} aria-label="Search"')


def preview(page: Page, config: MkDocsConfig) -> str:
    """Return the tags of a page's title, description and picture."""
    from lag_envs.tasks import TASKS

    title, about = page.meta.get("title", page.title), unescape(page.meta["description"])
    picture = page.title if page.title in TASKS else next(iter(TASKS))
    tags = {"type": "article", "site_name": config.site_name, "title": title, "description": about}
    card = ""
    if config.site_url:
        tags["url"] = page.canonical_url
        if (ROOT / "docs" / MOVING / f"{picture}.webp").is_file():
            tags["image"] = f"{config.site_url}{MOVING}/{picture}-still.webp"
            card = '<meta name="twitter:card" content="summary_large_image">\n'
    found = (f'<meta property="og:{name}" content="{escape(str(of))}">\n' for name, of in tags.items())
    return "".join(found) + card
