"use strict";
/* Light or dark as readers chose it in the documentation, whose theme stores it under its root's path.
 *
 * It runs before anything is painted. Without a choice, the page follows the system.
 */
(() => {
  const { dataset } = document.documentElement;
  const key = `${new URL(document.currentScript.dataset.root, location).pathname}.__palette`;

  function follow() {
    let palette = null;
    try {
      palette = JSON.parse(localStorage.getItem(key));
    } catch {
      // Storage is forbidden, or holds something else.
    }
    const scheme = String(palette?.color?.scheme ?? "");
    if (dataset.scheme !== scheme) dataset.scheme = scheme;
  }

  /** Switch between light and dark, and store the choice as the theme does: its number, and its scheme. */
  function choose() {
    const dark = getComputedStyle(document.documentElement).colorScheme === "dark";
    const scheme = dark ? "default" : "slate";
    dataset.scheme = scheme;
    try {
      localStorage.setItem(key, JSON.stringify({ index: Number(!dark), color: { scheme } }));
    } catch {
      // Storage is forbidden or full: the choice is this page's.
    }
  }

  document.addEventListener("DOMContentLoaded", () => {
    const button = document.querySelector(".scheme");
    button.hidden = false;
    button.addEventListener("click", choose);
  });
  follow();
  // The choice may change in another tab, or before the reader comes back.
  addEventListener("storage", follow);
  addEventListener("pageshow", follow);
})();
