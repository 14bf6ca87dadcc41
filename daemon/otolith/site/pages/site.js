"use strict";
// The live part: replaces the cards that changed. Without it the pages work, and are of the time at which they were made.
(() => {
  const list = document.getElementById("cards"), status = document.getElementById("live");
  if (!list || !window.EventSource) return;
  const still = status.textContent, order = (card) => card.dataset.order;
  const source = new EventSource(list.dataset.live);
  const place = (card) => {
    const next = [...list.children].find((other) => other !== card && order(other) > order(card));
    const focused = card.contains(document.activeElement);
    if (card.nextElementSibling !== (next || null)) list.insertBefore(card, next || null);
    if (focused) card.querySelector("a").focus({ preventScroll: true });
  };
  source.addEventListener("open", () => { status.textContent = status.dataset.live; });
  source.addEventListener("error", () => { status.textContent = still; });
  source.addEventListener("card", (message) => {
    const { id, html } = JSON.parse(message.data), old = document.getElementById(id);
    if (html === null) { if (old) old.remove(); return; }
    const template = document.createElement("template");
    template.innerHTML = html;
    const card = template.content.firstElementChild;
    const focused = old && old.contains(document.activeElement);
    if (old) old.replaceWith(card); else list.append(card);
    if (focused) card.querySelector("a").focus({ preventScroll: true });
    place(card);
  });
  source.addEventListener("counts", (message) => {
    for (const [name, count] of Object.entries(JSON.parse(message.data))) {
      const place = document.getElementById(`count-${name}`);
      if (place) place.textContent = count;
    }
  });
})();
