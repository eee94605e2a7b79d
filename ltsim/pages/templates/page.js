"use strict";
for (const scene of document.querySelectorAll(".scene")) {
  const release = () => scene.classList.remove("live");
  scene.querySelector(".leave").addEventListener("click", release);
  scene.querySelector(".take").addEventListener("click", () => scene.classList.add("live"));
  scene.addEventListener("pointerleave", (event) => { if (event.pointerType === "mouse") release(); });
  document.addEventListener("keydown", (event) => { if (event.key === "Escape") release(); });
  document.addEventListener("pointerdown", (event) => { if (!scene.contains(event.target)) release(); });
}
addEventListener("beforeprint", () => {
  for (const folded of document.querySelectorAll("details:not(.listing, .endless, [open])")) {
    folded.open = true;
    addEventListener("afterprint", () => { folded.open = false; }, { once: true });
  }
});
