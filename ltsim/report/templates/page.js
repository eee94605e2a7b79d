"use strict";
for (const scene of document.querySelectorAll(".scene")) {
  const release = () => scene.classList.remove("live");
  scene.querySelector("button").addEventListener("click", () => scene.classList.add("live"));
  scene.addEventListener("mouseleave", release);
  document.addEventListener("keydown", (event) => { if (event.key === "Escape") release(); });
  document.addEventListener("pointerdown", (event) => { if (!scene.contains(event.target)) release(); });
}
addEventListener("beforeprint", () => {
  for (const folded of document.querySelectorAll("details")) folded.open = true;
});
