// Shows the API. On a server that needs tokens, the token that was entered in the dashboard in this tab is used.

"use strict";

const token = sessionStorage.getItem("livessl-token");

SwaggerUIBundle({
  dom_id: "#viewer",
  url: "api/v1/openapi.json",
  validatorUrl: null, // the validator is on another server
  requestInterceptor: (request) => {
    if (token !== null && !request.headers.Authorization) request.headers.Authorization = `Bearer ${token}`;
    return request;
  },
});
