"use strict";
const unpacked = async (text) => {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
};
for (const button of document.querySelectorAll(".scene button")) {
  const scene = button.parentElement, packed = scene.querySelector("script").textContent;
  button.addEventListener("click", async () => {
    const open = scene.querySelector("iframe");
    button.textContent = open ? "Turn it" : "Done";
    if (open) return open.remove();
    const frame = document.createElement("iframe");
    frame.title = "The hall in 3D";
    frame.srcdoc = await unpacked(packed);
    scene.append(frame);
  });
}
addEventListener("beforeprint", () => {
  for (const folded of document.querySelectorAll("details:not(.listing, .endless, [open])")) {
    folded.open = true;
    addEventListener("afterprint", () => { folded.open = false; }, { once: true });
  }
});
